"""The ladder: what is compared, how it is summed up, and the command from its first line to its files."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from izoo import zoo
from izoo.benchmarks import ladder, twin
from izoo.benchmarks.kept_rows import KeptRows
from izoo.benchmarks.ladder_options import LadderConfig
from izoo.benchmarks.side_by_side import SideBySide, parting
from izoo.conf import compose
from izoo.contexts.procedural import procedural_context
from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.errors import IzooError
from izoo.evaluation.policies import as_candidate
from izoo.evaluation.selection import EpisodeSeeds
from izoo.evaluation.table import COLUMNS, make_table
from tests.networks.test_dataset import write


def episode(
    policy: str, approach: str, seed: int, crossed: float, emission_g: float, lanes: int = 1, adoption: float = 0.5
) -> dict[str, object]:
    about = {"policy": policy, "context": "c", "context_hash": f"h{adoption}", "approach": approach, "seed": seed}
    about |= {"adoption": adoption, "demand": "all"}
    sums = {"crossed": crossed, "emission_g": emission_g, "travel_time_s": 10.0 * crossed, "stopped_time_s": 0.0}
    return {**about, **sums, "lane_count": lanes}


def test_an_approach_is_compared_by_hand() -> None:
    sumo = [episode("glide", "A", 1, 10, 1000.0), episode("glide", "A", 2, 10, 1200.0)]
    twin_rows = [episode("glide", "A", 1, 10, 1100.0), episode("glide", "A", 2, 20, 2200.0)]
    row = ladder.approaches(pd.DataFrame(sumo), pd.DataFrame(twin_rows)).iloc[0]
    assert row["co2_g_sumo"] == pytest.approx(110.0) and row["co2_g_twin"] == pytest.approx(110.0)
    assert row["co2_g_difference"] == pytest.approx(0.0) and row["crossed_difference"] == pytest.approx(0.5)
    assert np.isnan(row["stopped_s_difference"]) and row["lane_count"] == 1
    assert row["adoption"] == 0.5 and row["demand"] == "all"


def test_an_approach_that_nobody_crosses_has_no_difference() -> None:
    sumo, played = [episode("glide", "A", 1, 0, 0.0)], [episode("glide", "A", 1, 3, 300.0)]
    table = ladder.approaches(pd.DataFrame(sumo), pd.DataFrame(played))
    assert np.isnan(table["co2_g_difference"].iloc[0])
    assert ladder.rungs(table)["approaches"].iloc[0] == 0


def everybody(**emission_g: float) -> pd.DataFrame:
    """Return an evaluation of two seeds in which 10 vehicles cross each approach; CO2 (g) by approach."""
    return pd.DataFrame([episode("glide", name, seed, 10, g) for name, g in emission_g.items() for seed in (1, 2)])


def test_differences_beyond_sumos_own_spread_are_counted() -> None:
    sumo, played = everybody(A=1000.0, B=1000.0, C=1000.0), everybody(A=1040.0, B=900.0, C=1070.0)
    late = [everybody(A=1000.0, B=1010.0, C=1020.0), everybody(A=1000.0, B=990.0, C=960.0)]
    own = ladder.own_spread(sumo, late)
    compared = ladder.with_spread(ladder.approaches(sumo, played), own)
    assert compared["co2_g_own"].tolist() == pytest.approx([0.0, 0.01, 0.03])  # sizes, which do not cancel
    row = ladder.rungs(compared).iloc[0]
    assert row["co2_mean_abs"] == pytest.approx(0.07) and row["co2_bias"] == pytest.approx(0.01 / 3)
    assert row["co2_wide"] == 2 and row["co2_beyond"] == 1 and row["co2_worst"] == pytest.approx(0.1)
    assert row["co2_own"] == pytest.approx(0.04 / 3) and row["crossed_own"] == 0.0
    itself = ladder.rungs(own, "late").iloc[0]
    assert itself["approaches"] == 6 and itself["co2_mean_abs"] == pytest.approx(0.04 / 3)
    assert itself["co2_bias"] == pytest.approx(-0.01 / 3)
    without = ladder.rungs(ladder.with_spread(ladder.approaches(sumo, played), ladder.own_spread(sumo, []))).iloc[0]
    assert without["co2_beyond"] == without["co2_wide"] == 2 and np.isnan(without["co2_own"])


def test_human_driving_is_compared_once_whatever_the_share_of_cvs() -> None:
    rows = [episode(policy, "A", 1, 10, 1000.0, adoption=a) for policy in ("human", "glide") for a in (0.5, 1.0)]
    summed = ladder.rungs(ladder.approaches(pd.DataFrame(rows), pd.DataFrame(rows)))
    found = sorted(zip(summed["policy"], summed["adoption"], summed["approaches"], strict=True))
    assert found == [("glide", 0.5, 1), ("glide", 1.0, 1), ("human", 0.0, 1)]


def test_kolmogorov_smirnov_distance() -> None:
    assert ladder.ks_distance(np.array([1.0, 1.0, 2.0]), np.array([2.0, 2.0, 4.0])) == 0.0
    assert ladder.ks_distance(np.array([1.0, 0.0]), np.array([0.0, 5.0])) == 1.0
    assert np.isnan(ladder.ks_distance(np.zeros(2), np.ones(2)))


def test_the_same_order() -> None:
    gained = pd.DataFrame({"policy": ["a", "b"], "sumo": [0.1, 0.2], "twin": [0.0, 0.01]})
    gained = gained.assign(adoption=1.0, demand="all")
    assert ladder.same_order(gained)
    assert not ladder.same_order(gained.assign(twin=[0.3, 0.01]))
    # Policies at different shares of CVs are not ranked against each other.
    assert ladder.same_order(gained.assign(twin=[0.3, 0.01], adoption=[0.5, 1.0]))


def test_what_late_vehicles_change_of_a_gain() -> None:
    def table(human_g: float, glide_g: float) -> pd.DataFrame:
        rows = [episode("human", "A", 1, 10, human_g), episode("glide", "A", 1, 10, glide_g)]
        return make_table([{**dict.fromkeys(COLUMNS, 0), "due": 10, "entered": 10, **row} for row in rows])

    row = ladder.gains(table(1000.0, 900.0), table(1000.0, 930.0), [table(1000.0, 910.0), table(1000.0, 880.0)]).iloc[0]
    assert row["sumo"] == pytest.approx(0.1) and row["difference"] == pytest.approx(-0.03)
    assert row["own"] == pytest.approx(0.015) and row["adoption"] == 0.5 and row["demand"] == "all"


def test_where_two_scenes_part() -> None:
    context = procedural_context(inflow_vph_per_lane=400.0, approach="all")
    env = EcoDrivingEnv(context, config=EnvConfig(horizon_s=60.0, warmup_s=30.0, emit=()), worker=0)
    try:
        env.reset(seed=1)
        scene = env.scene()
    finally:
        env.close()
    assert parting(1, scene, scene) is None
    moved = {**scene.vehicles, "lane_position_m": scene.vehicles["lane_position_m"].copy()}
    moved["lane_position_m"][-1] += 0.5
    found = parting(7, scene, scene._replace(vehicles=moved))
    assert found is not None and found.step == 7 and found.vehicle == scene.vehicles["vehicle_number"][-1]
    fewer = {name: column[1:] for name, column in scene.vehicles.items()}
    gone = parting(7, scene, scene._replace(vehicles=fewer))
    assert gone is not None and gone.twin[0] == "" and "outside" in str(gone)


def test_rows_are_kept_and_those_of_other_plays_are_left_out(tmp_path: Path) -> None:
    types = {"name": "str", "seed": "int64", "done": "bool", "parted": "Int64", "where": "str"}
    path, key = tmp_path / "rows.csv", ("name", "seed", "done")
    kept = KeptRows(path, types, key)
    assert kept.table([]).empty and list(kept.table([])) == list(types)
    kept.add({"name": "0012", "seed": 1, "done": False, "parted": None, "where": ""})
    kept.add({"name": "b", "seed": 1, "done": True, "parted": 7, "where": "step 7"})
    again = KeptRows(path, types, key)
    assert ("0012", 1, False) in again and ("0012", 2, False) not in again
    found = again.table([("b", 1, True), ("c", 1, True)])
    assert found["parted"].tolist() == [7] and found["name"].tolist() == ["b"]
    plain = again.table([("0012", 1, False)])
    assert plain["parted"].isna().all() and plain["where"].tolist() == [""]


@pytest.mark.parametrize("content", ["", "name,seed\na,1\n", "name,seed,more\na,x,1\n"])
def test_a_file_that_is_no_such_table_is_begun_anew(
    content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rows.csv").write_text(content)
    kept = KeptRows(tmp_path / "rows.csv", {"name": "str", "seed": "int64", "more": "float"}, ("name", "seed"))
    assert ("a", 1) not in kept and "begun anew" in capsys.readouterr().out


def test_who_played_without_counts_is_left_out_of_what_drivers_did() -> None:
    rows = pd.DataFrame({"policy": ["glide"], "demand": ["one"], **{name: [np.nan] for name in ladder.COUNTED}})
    assert ladder.conduct(rows).empty
    both = pd.concat([rows, rows.fillna(2.0)], ignore_index=True)
    assert (ladder.conduct(both).set_index("measure")["sumo"]["passed_left_red"]) == 2.0


@pytest.mark.slow
def test_both_are_compared_after_each_decision() -> None:
    """Of 65 s the last decision of 2 s is cut short."""
    both = SideBySide(EnvConfig(horizon_s=95.0, warmup_s=30.0, hold_s=2.0, emit=()))
    try:
        played = both.play(as_candidate("glide", EnvConfig()).policy, procedural_context(adoption=0.5), 1)
    finally:
        both.close()
    assert played.steps == 130 and played.parting is None, str(played.parting)
    assert played.conducts is None, "between decisions nobody sees who passes when"
    sumo, twin_ = (int(motion.speed.sum()) for motion in played.motions)
    assert sumo == twin_ > 33


@pytest.mark.slow
def test_a_late_vehicle_is_late_in_sumo_and_on_the_twin() -> None:
    context = procedural_context(inflow_vph_per_lane=400.0, lane_count=1, adoption=0.5)
    seen = {}
    for late_vehicle in (0, 3):
        both = SideBySide(EnvConfig(horizon_s=120.0, warmup_s=30.0, emit=(), late_vehicle=late_vehicle))
        try:
            played = both.play(as_candidate("uncommanded", EnvConfig()).policy, context, 1)
        finally:
            both.close()
        assert played.parting is None, str(played.parting)
        sumo, twin_ = (conduct.counts() for conduct in played.conducts or ())
        assert sumo == twin_ and sumo["passed_straight_priority"] > 0
        seen[late_vehicle] = played.motions
    assert all(not np.array_equal(one.speed, late.speed) for one, late in zip(seen[0], seen[3], strict=True))


def test_the_options_file_is_the_dataclass() -> None:
    assert compose.compose_config("benchmarks.twin", LadderConfig, []) == LadderConfig()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"policies": ("human",)}, "leave it out"),
        ({"policies": ("glid",)}, "glide"),
        ({"adoptions": (1.5,)}, r"\[0, 1\]"),
        ({"adoptions": ()}, "each need one entry"),
        ({"late": -1}, "late"),
        ({"env": EnvConfig(late_vehicle=2)}, "env.late_vehicle=0"),
    ],
)
def test_bad_options(options: dict[str, tuple[object, ...]], said: str) -> None:
    with pytest.raises(IzooError, match=said):
        LadderConfig(**options)  # type: ignore[arg-type]


def test_a_window_is_refused_before_anything_is_played(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert twin.main(["contexts=pcg_easy", "env.gui=true", f"out={tmp_path}/ladder"]) == 2
    error = capsys.readouterr().err
    assert "the twin has no window" in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_net_that_the_twin_cannot_play_is_refused_before_anything_is_played(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second of two."""
    for name, kind in (("1", "static"), ("2", "actuated")):
        write(tmp_path / "nets" / name)
        path = tmp_path / "nets" / name / "net.net.xml"
        path.write_text(path.read_text().replace('type="static"', f'type="{kind}"'))
    words = ["contexts=dataset", f"contexts.path={tmp_path}/nets", f"out={tmp_path}/ladder", "num_workers=0"]
    assert twin.main(words) == 2
    said = capsys.readouterr()
    assert "context nets/2/A: " in said.err and "is of type actuated" in said.err and said.err.count("\n") == 1
    assert "sumo:" not in said.out and not (tmp_path / "ladder").exists()


@pytest.mark.slow
def test_the_command_goes_on_where_it_was(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["contexts=pcg_easy", "num_contexts=1", "seeds=2", "env.horizon_s=90", "env.warmup_s=30", "adoptions=[0.5]"]
    words += ["demand=[given]", "policies=[uncommanded]", "exact=[uncommanded]", "num_workers=0"]
    words += [f"out={tmp_path}/ladder", f"cache={tmp_path}/cache"]
    assert twin.main(words) == 0
    first = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "ladder").glob("[ef]*.csv")}
    assert set(first) == {"exact.csv", "few.csv"}
    found = json.loads((tmp_path / "ladder" / "ladder.json").read_text())
    assert found["contexts"] == 1 and {row["policy"] for row in found["approaches"]} == {"human", "uncommanded"}
    played = [[row["policy"] for row in found[kind]] for kind in ("own", "approaches")]
    assert found["late"] == 1 and played[0] == played[1]
    assert any(row["co2_mean_abs"] > 0.0 for row in found["own"])  # the late vehicle did come late
    assert [row["same"] for row in found["few"]] == [1, 1, 1]  # one vehicle, two, and two commanded
    measured = {row["measure"]: (row["sumo"], row["twin"]) for row in found["conduct"]}
    assert measured["passed"][0] > 0 and measured["passed"][0] == measured["passed"][1]
    assert found["exact"][0]["episodes"] == 1 and (tmp_path / "ladder" / "ladder.png").stat().st_size > 10_000
    assert twin.main(words) == 0  # nothing is left to be played
    assert {path.name: path.stat().st_mtime_ns for path in (tmp_path / "ladder").glob("[ef]*.csv")} == first
    shown = capsys.readouterr().out
    rungs = ("1. One and two", "2. Every vehicle", "3. What drivers did", "4. CO2 per vehicle", "5. Benefit over human")
    assert all(rung in shown for rung in rungs)


def test_tables_fit_a_terminal_of_80_columns() -> None:
    rows = [episode("uncommanded", "A", 1, 10, 1000.0, lanes=lanes) | {"context": f"c{lanes}"} for lanes in (1, 2)]
    table = pd.DataFrame(rows)
    table = pd.concat([table, table.assign(policy="measured_search")], ignore_index=True)
    own = ladder.own_spread(table, [table])
    rungs = ladder.rungs(ladder.with_spread(ladder.approaches(table, table), own))
    gained = pd.DataFrame({"policy": ["uncommanded"], "sumo": [-0.1], "twin": [-0.2], "difference": [-0.1]})
    gained = gained.assign(adoption=1.0, demand="all", own=0.01)
    few = pd.DataFrame({"vehicles": [1, 2], "commanded": [False, True], "episodes": 160, "same": 160})
    exact = {"policy": ["uncommanded", "measured_search"], "demand": "given", "kind": "several lanes"}
    exact |= {"episodes": 160, "same": 7, "median_parted": 1234.0, "ks_speed": 0.001, "ks_accel": 0.001}
    done = {"policy": "uncommanded", "demand": "given", "measure": list(ladder.MEASURE_TITLES), "sumo": 12345.6}
    found = (few, pd.DataFrame(exact), pd.DataFrame(done | {"twin": 12345.0}), rungs, ladder.rungs(own, "late"), gained)
    for shown in ladder.tables(ladder.Ladder(*found)):
        out = io.StringIO()
        Console(file=out, width=80).print(shown)
        assert "\u2026" not in out.getvalue() and all(len(line) <= 80 for line in out.getvalue().splitlines())
        assert all(str(cell) in out.getvalue() for cell in shown.columns[0].cells), "a name is folded"
        assert all(str(column.header) in out.getvalue() for column in shown.columns)


@pytest.mark.slow
def test_ctrl_c_ends_the_command_in_good_order(tmp_path: Path) -> None:
    words = [
        "contexts=pcg",
        "num_contexts=2",
        "num_workers=1",
        f"out={tmp_path / 'out'}",
        f"cache={tmp_path / 'cache'}",
    ]
    with subprocess.Popen(
        [sys.executable, "-m", "izoo.benchmarks.twin", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler) and None,
    ) as child:
        assert child.stdout is not None
        while not child.stdout.readline().startswith("sumo:"):
            assert child.poll() is None
        child.send_signal(signal.SIGINT)
        _, errors = child.communicate(timeout=120)
    assert child.returncode == 130, errors
    assert "the same command goes on" in errors and "Traceback" not in errors


def test_policies_of_the_zoo_are_played_in_their_own_environment() -> None:
    config = LadderConfig(policies=("glide", "zoo:measured_search"), env=EnvConfig(horizon_s=90.0))
    env = twin.env_of(config, frozenset({"env.horizon_s"}))
    own = zoo.load("measured_search").env
    assert (env.hold_s, env.observed, env.horizon_s) == (own.hold_s, own.observed, 90.0)
    assert own.hold_s != EnvConfig().hold_s
    assert twin.env_of(LadderConfig(), frozenset()) == EnvConfig()


def evaluated(*contexts: tuple[str, float, float]) -> pd.DataFrame:
    """Return an evaluation of glide and human driving: contexts, vehicles that cross, and what glide burns (g)."""
    rows = []
    for name, crossed, glide_g in contexts:
        for policy, g in (("human", 100.0 * crossed), ("glide", glide_g)):
            rows.append(episode(policy, "A", 1, crossed, g) | {"context": name, "context_hash": name, "entered": 10.0})
    return make_table(rows)


def test_approaches_that_human_drivers_do_not_cross_have_no_part_in_a_gain() -> None:
    table = evaluated(("free", 10.0, 900.0), ("free too", 10.0, 900.0), ("blocked", 0.0, 0.0))
    assert ladder.gains(table, table)["sumo"].tolist() == pytest.approx([0.1])
    blocked = evaluated(("blocked", 0.0, 0.0))
    found = ladder.gains(blocked, blocked)
    assert found["sumo"].isna().all() and ladder.same_order(found)
    out = io.StringIO()
    Console(file=out, width=80).print(ladder._benefits(found))
    assert "nan" not in out.getvalue()


def test_a_context_in_which_nobody_drives_is_not_played_side_by_side(tmp_path: Path) -> None:
    quiet = procedural_context(inflow_vph_per_lane=0.0)
    assert quiet.demand_approaches == ()
    glide = [as_candidate("glide", EnvConfig())]
    found = twin.compare_steps([quiet], EpisodeSeeds(0, 1), LadderConfig(), glide, tmp_path / "exact.csv")
    assert found.empty and list(found) == [*twin.STEPS_COLUMNS, *ladder.COUNTED]
    assert ladder.exactness(found).empty and ladder.conduct(found).empty


@pytest.mark.slow
def test_what_a_folder_holds_of_other_options_is_not_compared(tmp_path: Path) -> None:
    """The same numbers as in a folder of its own."""
    words = ["contexts=pcg_easy", "num_contexts=1", "seeds=1", "env.horizon_s=90", "env.warmup_s=30", "adoptions=[0.5]"]
    words += ["demand=[given]", "exact=[]", "num_workers=0", f"cache={tmp_path}/cache"]
    before, now = ["policies=[uncommanded,glide]", "late=0"], ["policies=[random]", "seed=1"]
    for name, runs in (("shared", (before, now)), ("own", (now,))):
        for options in runs:
            assert twin.main([*words, *options, f"out={tmp_path / name}"]) == 0
    shared, own = (json.loads((tmp_path / name / "ladder.json").read_text()) for name in ("shared", "own"))
    assert {row["policy"] for row in own["approaches"]} == {"human", "uncommanded", "random"}
    assert {row["policy"]: row for row in shared["approaches"]} == {row["policy"]: row for row in own["approaches"]}
    assert shared["gains"] == own["gains"] and len(own["gains"]) == 2


@pytest.mark.parametrize("example", twin.COMMAND.examples)
def test_the_examples_of_the_help_are_good(example: str) -> None:
    compose.compose_config(twin.COMMAND.name, LadderConfig, twin.COMMAND.options(example.split()[1:]))
