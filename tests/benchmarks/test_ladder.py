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

from izoo.benchmarks import ladder, twin
from izoo.benchmarks.ladder_options import LadderConfig
from izoo.benchmarks.side_by_side import parting
from izoo.conf import compose
from izoo.contexts.procedural import procedural_context
from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.errors import IzooError


def episode(
    policy: str, approach: str, seed: int, crossed: float, emission_g: float, lanes: int = 1
) -> dict[str, object]:
    about = {"policy": policy, "context": "c", "context_hash": "h", "approach": approach, "seed": seed}
    sums = {"crossed": crossed, "emission_g": emission_g, "travel_time_s": 10.0 * crossed, "stopped_time_s": 0.0}
    return {**about, **sums, "lane_count": lanes}


def test_an_approach_is_compared_by_hand() -> None:
    sumo = [episode("glide", "A", 1, 10, 1000.0), episode("glide", "A", 2, 10, 1200.0)]
    twin_rows = [episode("glide", "A", 1, 10, 1100.0), episode("glide", "A", 2, 20, 2200.0)]
    row = ladder.approaches(pd.DataFrame(sumo), pd.DataFrame(twin_rows)).iloc[0]
    assert row["co2_g_sumo"] == pytest.approx(110.0) and row["co2_g_twin"] == pytest.approx(110.0)
    assert row["co2_g_difference"] == pytest.approx(0.0) and row["crossed_difference"] == pytest.approx(0.5)
    assert row["co2_g_spread"] == pytest.approx(10.0 / 110.0)  # the standard error of 100 and 120, relative
    assert np.isnan(row["stopped_s_difference"]) and row["lanes"] == 1


def test_an_approach_that_nobody_crosses_has_no_difference() -> None:
    sumo, played = [episode("glide", "A", 1, 0, 0.0)], [episode("glide", "A", 1, 3, 300.0)]
    table = ladder.approaches(pd.DataFrame(sumo), pd.DataFrame(played))
    assert np.isnan(table["co2_g_difference"].iloc[0])
    assert ladder.rungs(table)["approaches"].iloc[0] == 0


def test_differences_beyond_sumos_own_spread_are_counted() -> None:
    sumo = [episode("glide", name, seed, 10, 1000.0) for name in "AB" for seed in (1, 2)]
    played = [episode("glide", "A", seed, 10, 1040.0) for seed in (1, 2)]
    played += [episode("glide", "B", seed, 10, 900.0) for seed in (1, 2)]
    row = ladder.rungs(ladder.approaches(pd.DataFrame(sumo), pd.DataFrame(played))).iloc[0]
    assert row["co2_mean_abs"] == pytest.approx(0.07) and row["co2_bias"] == pytest.approx(-0.03)
    assert row["co2_beyond"] == 1 and row["co2_worst"] == pytest.approx(0.1)


def test_kolmogorov_smirnov_distance() -> None:
    assert ladder.ks_distance(np.array([1.0, 1.0, 2.0]), np.array([2.0, 2.0, 4.0])) == 0.0
    assert ladder.ks_distance(np.array([1.0, 0.0]), np.array([0.0, 5.0])) == 1.0
    assert np.isnan(ladder.ks_distance(np.zeros(2), np.ones(2)))


def test_the_same_order() -> None:
    gained = pd.DataFrame({"policy": ["a", "b"], "sumo": [0.1, 0.2], "twin": [0.0, 0.01]})
    assert ladder.same_order(gained)
    assert not ladder.same_order(gained.assign(twin=[0.3, 0.01]))


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


def test_the_options_file_is_the_dataclass() -> None:
    assert compose.compose_config("benchmarks.twin", LadderConfig, []) == LadderConfig()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"policies": ("human",)}, "leave it out"),
        ({"policies": ("glid",)}, "glide"),
        ({"adoptions": (1.5,)}, r"\[0, 1\]"),
        ({"adoptions": ()}, "each need one entry"),
    ],
)
def test_bad_options(options: dict[str, tuple[object, ...]], said: str) -> None:
    with pytest.raises(IzooError, match=said):
        LadderConfig(**options)  # type: ignore[arg-type]


@pytest.mark.slow
def test_the_command_goes_on_where_it_was(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["contexts=pcg_easy", "num_contexts=1", "seeds=2", "env.horizon_s=90", "env.warmup_s=30", "adoptions=[0.5]"]
    words += ["demand=[given]", "policies=[uncommanded]", "exact=[uncommanded]", "num_workers=0"]
    words += [f"out={tmp_path}/ladder", f"cache={tmp_path}/cache"]
    assert twin.main(words) == 0
    first = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "ladder").glob("exact.csv")}
    found = json.loads((tmp_path / "ladder" / "ladder.json").read_text())
    assert found["contexts"] == 1 and {row["policy"] for row in found["approaches"]} == {"human", "uncommanded"}
    assert found["exact"][0]["episodes"] == 1 and (tmp_path / "ladder" / "ladder.png").stat().st_size > 10_000
    assert twin.main(words) == 0  # nothing is left to be played
    assert {path.name: path.stat().st_mtime_ns for path in (tmp_path / "ladder").glob("exact.csv")} == first
    assert "Benefit over human driving" in capsys.readouterr().out


def test_tables_fit_a_terminal_of_80_columns() -> None:
    rows = [episode("uncommanded", "A", 1, 10, 1000.0, lanes=lanes) | {"context": f"c{lanes}"} for lanes in (1, 2)]
    table = pd.DataFrame(rows)
    rungs = ladder.rungs(ladder.approaches(table, table))
    gained = pd.DataFrame({"policy": ["uncommanded"], "sumo": [-0.1], "twin": [-0.2], "difference": [-0.1]})
    for shown in ladder.tables(pd.DataFrame(), rungs, gained):
        out = io.StringIO()
        Console(file=out, width=80).print(shown)
        assert "\u2026" not in out.getvalue() and all(len(line) <= 80 for line in out.getvalue().splitlines())
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


def test_policies_that_one_side_has_not_played_yet_have_no_gain() -> None:
    """A folder may hold what was played before the options were changed."""
    twin_rows = [episode("human", "A", 1, 10, 1000.0)]
    sumo = [*twin_rows, episode("glide", "A", 1, 10, 900.0)]
    assert ladder.gains(pd.DataFrame(sumo), pd.DataFrame(twin_rows)).empty


@pytest.mark.parametrize("example", twin.COMMAND.examples)
def test_the_examples_of_the_help_are_good(example: str) -> None:
    compose.compose_config(twin.COMMAND.name, LadderConfig, twin.COMMAND.options(example.split()[1:]))
