"""The speed benchmark: what cannot be measured is refused, and every row says how fast something is."""

import math

import pytest

from izoo.benchmarks import speed
from izoo.benchmarks.timing.clocks import CORES, Timed
from tests.conftest import Refused


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["workers=0"], "workers is 0"),
        (["threads=[0]"], "threads is 0"),
        (["envs=[0]"], "envs is 0"),
        (["seconds=0"], "seconds is 0"),
        (["scenario=lihgt"], "it must be one of two_lanes"),
        (["rows=[twni]"], "each entry one of sumo"),
    ],
)
def test_what_cannot_be_measured_is_refused(words: list[str], message: str, refused: Refused) -> None:
    refused(speed.main, words, message)


def test_the_serial_share_bounds_the_speed_up() -> None:
    assert Timed(1, 1.0, 0.0, 1.0).most == CORES
    assert Timed(1, 1.0, 1.0, 0.0).most == 1.0
    assert math.isclose(Timed(1, 1.0, 0.04, 0.96).most, 10.0)


@pytest.mark.slow
def test_every_row_says_how_fast_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    config = speed.SpeedConfig(envs=(4,), threads=(1, 2), seconds=0.05, starting=3, workers=1, device="cpu")
    rows = {row.name: row for row in speed.run(config)}
    said = capsys.readouterr()
    assert "speed" in said.out and "6 / 6 rows" not in said.out  # the bar is on the error stream
    stepped = rows["twin 4 x 2, all groups"]
    assert stepped.timed is not None and 0.0 < stepped.timed.serial_share < 1.0
    assert stepped.vehicles == pytest.approx(rows["SUMO, one environment"].vehicles, rel=0.3)
    assert all(row.env_steps_per_s > 0.0 or "vehicles/s" in row.note for row in rows.values())
    assert rows["training 4 x 2, cpu"].agent_steps_per_s
