"""The twin beside SUMO: what is compared, how it is summed up, and the command from its first line to its files."""

import contextlib
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from izoo import zoo
from izoo.benchmarks import twin
from izoo.benchmarks.fidelity import twin_fidelity
from izoo.benchmarks.fidelity.trajectory_diff import Watched, compare_steps, compared
from izoo.benchmarks.twin import FidelityConfig
from izoo.contexts.context import Context
from izoo.contexts.procedural import procedural_context
from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.errors import IzooError
from izoo.results import read_table
from izoo.results.policies import as_policy
from izoo.results.rows_file import RowsFile
from izoo.results.schema import COLUMNS, make_table
from izoo.results.selection import EpisodeSeeds
from tests.conftest import Refused
from tests.metrics.tables import episode_row
from tests.networks.test_dataset import write


def episode(
    policy: str, approach: str, seed: int, co2_g: float, cohort: float = 10.0, lanes: int = 1, adoption: float = 0.5
) -> dict[str, Any]:
    """Return a row in which every vehicle of the cohort crosses and leaves, and burns ``co2_g``."""
    made = episode_row(co2_g, 0.0, policy=policy, approach=approach, seed=seed, cohort=cohort, demand="all")
    made |= {"context": "c", "context_hash": f"h{adoption}", "intersection": approach, "adoption": adoption}
    return dict.fromkeys(COLUMNS, 0.0) | made | {"lane_count": lanes}


def rows(*episodes: dict[str, Any]) -> pd.DataFrame:
    return make_table(episodes)


def test_an_approach_is_compared_by_hand() -> None:
    sumo = rows(episode("glide", "A", 1, 100.0), episode("glide", "A", 2, 120.0))
    other = rows(episode("glide", "A", 1, 110.0), episode("glide", "A", 2, 110.0, cohort=20))
    row = twin_fidelity.approaches(sumo, other).iloc[0]
    assert row["co2_g_sumo"] == pytest.approx(110.0) and row["co2_g_other"] == pytest.approx(110.0)
    assert row["co2_g_difference"] == pytest.approx(0.0) and row["throughput_difference"] == pytest.approx(0.5)
    assert row["delay_s_difference"] == 0.0 and row["lane_count"] == 1
    assert row["adoption"] == 0.5 and row["demand"] == "all"


def test_an_approach_without_demand_has_no_difference() -> None:
    table = twin_fidelity.approaches(rows(episode("glide", "A", 1, 0.0, cohort=0)), rows(episode("glide", "A", 1, 3.0)))
    assert np.isnan(table["co2_g_difference"].iloc[0])
    assert twin_fidelity.by_group(table)["approaches"].iloc[0] == 0


def everywhere(**co2_g: float) -> pd.DataFrame:
    """Return two seeds of glide; CO2 per vehicle (g) by approach."""
    return rows(*(episode("glide", name, seed, g) for name, g in co2_g.items() for seed in (1, 2)))


def test_differences_beyond_sumos_own_spread_are_counted() -> None:
    sumo, played = everywhere(A=100.0, B=100.0, C=100.0), everywhere(A=104.0, B=90.0, C=107.0)
    late = [everywhere(A=100.0, B=101.0, C=102.0), everywhere(A=100.0, B=99.0, C=96.0)]
    own = twin_fidelity.own_spread(sumo, late)
    compared = twin_fidelity.with_spread(twin_fidelity.approaches(sumo, played), own)
    assert compared["co2_g_own"].tolist() == pytest.approx([0.0, 0.01, 0.03])  # sizes, which do not cancel
    row = twin_fidelity.by_group(compared).iloc[0]
    assert row["co2_mean_abs"] == pytest.approx(0.07) and row["co2_bias"] == pytest.approx(0.01 / 3)
    assert row["co2_wide"] == 2 and row["co2_beyond"] == 1
    assert row["co2_own"] == pytest.approx(0.04 / 3)
    itself = twin_fidelity.by_group(own).iloc[0]
    assert itself["approaches"] == 6 and itself["co2_mean_abs"] == pytest.approx(0.04 / 3)
    apart, none = twin_fidelity.approaches(sumo, played), twin_fidelity.own_spread(sumo, [])
    without = twin_fidelity.by_group(twin_fidelity.with_spread(apart, none)).iloc[0]
    assert without["co2_beyond"] == without["co2_wide"] == 2 and np.isnan(without["co2_own"])


def test_human_driving_is_compared_once_whatever_the_share_of_cvs() -> None:
    table = rows(*(episode(policy, "A", 1, 100.0, adoption=a) for policy in ("human", "glide") for a in (0.5, 1.0)))
    summed = twin_fidelity.by_group(twin_fidelity.approaches(table, table))
    found = sorted(zip(summed["policy"], summed["adoption"], summed["approaches"], strict=True))
    assert found == [("glide", 0.5, 1), ("glide", 1.0, 1), ("human", 0.0, 1)]


def test_the_same_order() -> None:
    gained = pd.DataFrame({"policy": ["a", "b"], "sumo": [0.1, 0.2], "twin": [0.0, 0.01]})
    gained = gained.assign(adoption=1.0, demand="all")
    assert twin_fidelity.same_order(gained)
    assert not twin_fidelity.same_order(gained.assign(twin=[0.3, 0.01]))
    # Policies at different shares of CVs are not ranked against each other.
    assert twin_fidelity.same_order(gained.assign(twin=[0.3, 0.01], adoption=[0.5, 1.0]))


def test_what_late_vehicles_change_of_a_gain() -> None:
    def table(human_g: float, glide_g: float) -> pd.DataFrame:
        return rows(episode("human", "A", 1, human_g), episode("glide", "A", 1, glide_g))

    found = twin_fidelity.gains(table(100.0, 90.0), table(100.0, 93.0), [table(100.0, 91.0), table(100.0, 88.0)])
    row = found.iloc[0]
    assert row["sumo"] == pytest.approx(10.0) and row["difference"] == pytest.approx(-3.0)
    assert row["own"] == pytest.approx(1.5) and row["adoption"] == 0.5 and row["demand"] == "all"
    compared = twin_fidelity.approaches(table(100.0, 90.0), table(100.0, 93.0))
    assert twin_fidelity.verdict(compared, found) == (
        "CO2 per vehicle on the twin is 1.7% from SUMO's on average over approaches; policies rank the same on both."
    )


def test_contexts_without_demand_have_no_part_in_a_gain() -> None:
    blocked = rows(*(episode(name, "A", 1, 0.0, cohort=0) for name in ("human", "glide")))
    found = twin_fidelity.gains(blocked, blocked)
    assert found["sumo"].isna().all() and twin_fidelity.same_order(found)
    out = io.StringIO()
    Console(file=out, width=80).print(twin_fidelity.headline(twin_fidelity.approaches(blocked, blocked), found).rich())
    assert "nan" not in out.getvalue()


def watched(policy: str, context: Context, config: EnvConfig) -> list[Watched]:
    """An episode in SUMO and on the twin."""
    found = []
    for simulator in ("sumo", "twin"):
        with contextlib.closing(EcoDrivingEnv(config=config, simulator=simulator)) as env:
            found.append(Watched(env, as_policy(policy, config).policy, context, 1))
    return found


@pytest.mark.slow
def test_both_are_compared_before_each_decision() -> None:
    """Of 65 s the last decision of 2 s is cut short."""
    config = EnvConfig(horizon_s=95.0, warmup_s=30.0, hold_s=2.0, emit=())
    row = compared(*watched("glide", procedural_context(adoption=0.5), config), config.hold_steps)
    assert row["decisions"] == 33 and row["parted"] is None and row["ks_speed"] == 0.0
    assert row["queues_sumo"] is None, "between decisions nobody sees which vehicle passes when"


@pytest.mark.slow
def test_a_late_vehicle_is_late_in_sumo_and_on_the_twin() -> None:
    context = procedural_context(inflow_vph_per_lane=400.0, lane_count=1, adoption=0.5)
    seen = {}
    for late_vehicle in (0, 3):
        config = EnvConfig(horizon_s=120.0, warmup_s=30.0, emit=(), late_vehicle=late_vehicle)
        both = watched("uncommanded", context, config)
        row = compared(*both)
        assert row["parted"] is None, row["where"]
        sumo, twin_ = (each.driving.counts() for each in both)
        assert sumo == twin_ and sumo["passed_straight_priority"] > 0
        seen[late_vehicle] = both[0].histograms["ks_speed"]
    assert not np.array_equal(seen[0], seen[3])


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
        FidelityConfig(**options)  # type: ignore[arg-type]


def test_a_net_that_the_twin_cannot_play_is_refused_before_anything_is_played(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second of two."""
    for name, kind in (("1", "static"), ("2", "actuated")):
        write(tmp_path / "nets" / name)
        path = tmp_path / "nets" / name / "net.net.xml"
        path.write_text(path.read_text().replace('type="static"', f'type="{kind}"'))
    words = ["contexts=dataset", f"contexts.path={tmp_path}/nets", f"out={tmp_path}/out", "num_workers=0"]
    assert twin.main(words) == 2
    said = capsys.readouterr()
    assert "nets/2/net.net.xml: " in said.err and "is of type actuated" in said.err and said.err.count("\n") == 1
    assert "sumo:" not in said.out and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_command_goes_on_where_it_was(tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Refused) -> None:
    words = ["contexts=pcg_easy", "num_contexts=1", "seeds=2", "env.horizon_s=150", "env.warmup_s=30"]
    words += ["adoptions=[0.5]", "demand=[given]", "policies=[uncommanded]", "exact=[uncommanded]", "num_workers=0"]
    out = tmp_path / "out"
    words += [f"out={out}", f"cache={tmp_path}/cache"]
    assert twin.main(words) == 0
    names = ("rows.csv", "late-1/rows.csv", "few.csv", "steps.csv")
    first = {name: (out / name).read_bytes() for name in names}
    assert set(read_table(out)["simulator"]) == {"sumo", "twin"}
    found = json.loads((out / "fidelity.json").read_text())
    assert found["contexts"] == 1 and {row["policy"] for row in found["groups"]} == {"human", "uncommanded"}
    assert found["late"] == 1 and [row["policy"] for row in found["own"]] == [row["policy"] for row in found["groups"]]
    assert any(row["co2_mean_abs"] > 0.0 for row in found["own"])  # the late vehicle did come late
    assert [row["same"] for row in found["few"]] == [1, 1, 1]  # one vehicle, two, and two commanded
    measured = {row["measure"]: (row["sumo"], row["twin"]) for row in found["driving"]}
    assert measured["passed"][0] > 0 and measured["passed"][0] == measured["passed"][1]
    assert found["exact"][0]["episodes"] == 1 and (out / "fidelity.png").stat().st_size > 10_000
    capsys.readouterr()
    assert twin.main([*words, "-v"]) == 0  # nothing is left to be played
    assert {name: (out / name).read_bytes() for name in names} == first
    shown = capsys.readouterr().out
    assert "\u2026" not in shown, "the tables fit 80 columns"
    assert all(f"\n{number}. " in shown for number in range(1, 6)) and "uncommanded" in shown
    assert shown.rstrip().splitlines()[-1].startswith("CO2 per vehicle on the twin is ")
    refused(twin.main, [*words, "env.horizon_s=151"], "horizon_s 150.0 -> 151.0")


def test_policies_of_the_zoo_are_played_in_their_own_environment() -> None:
    env = twin.COMMAND.compose(["policies=[glide,zoo:measured_search]", "env.horizon_s=90"]).env
    own = zoo.load("measured_search").env
    assert (env.hold_s, env.observed, env.horizon_s) == (own.hold_s, own.observed, 90.0)
    assert own.hold_s != EnvConfig().hold_s
    assert twin.COMMAND.compose([]).env == EnvConfig()


def test_a_context_in_which_nobody_drives_is_not_compared_step_by_step() -> None:
    quiet = procedural_context(inflow_vph_per_lane=0.0)
    assert quiet.demand_approaches == ()
    glide = [as_policy("glide", EnvConfig())]
    assert compare_steps([quiet], EpisodeSeeds(0, 1), EnvConfig(), glide, RowsFile(None, ())) == []
    assert twin_fidelity.exactness(pd.DataFrame()).empty and twin_fidelity.driving(pd.DataFrame()).empty


@pytest.mark.slow
def test_what_a_folder_holds_of_other_options_is_not_compared(tmp_path: Path) -> None:
    """The same numbers as in a folder of its own."""
    words = ["contexts=pcg_easy", "num_contexts=1", "seeds=1", "env.horizon_s=90", "env.warmup_s=30", "adoptions=[0.5]"]
    words += ["demand=[given]", "exact=[]", "num_workers=0", f"cache={tmp_path}/cache"]
    before, now = ["policies=[uncommanded,glide]", "late=0"], ["policies=[random]", "seed=1"]
    for name, runs in (("shared", (before, now)), ("own", (now,))):
        for options in runs:
            assert twin.main([*words, *options, f"out={tmp_path / name}"]) == 0
    shared, own = (json.loads((tmp_path / name / "fidelity.json").read_text()) for name in ("shared", "own"))
    assert {row["policy"] for row in own["groups"]} == {"human", "uncommanded", "random"}
    assert shared["groups"] == own["groups"]
    assert shared["gains"] == own["gains"] and len(own["gains"]) == 2
