"""An uncommanded episode equals that of the ``sumo`` program with the same files, step by step."""

import contextlib
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from izoo.contexts.context import Context
from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from tests.envs.reference import Steps, run_sumo
from tests.envs.worlds import crossing, defer, play

SEED = 11
CONFIG = EnvConfig(horizon_s=150.0, warmup_s=20.0)


def run_env(context: Context, config: EnvConfig) -> Steps:
    """The same from the environment, over its controlled region."""
    with contextlib.closing(EcoDrivingEnv(context, config=config)) as env:
        start = env.reset(context=context, seed=SEED)
        frames = play(env, config.control_steps, defer, start)
        lanes = env.road.lane_ids
    steps: Steps = defaultdict(dict)
    for t in range(len(frames) + 1):
        vehicles = frames[t]["vehicles"] if t < len(frames) else frames[-1]["next", "vehicles"]
        time_s = config.warmup_s + t * config.step_s
        for row in np.flatnonzero(vehicles["present"].numpy()):
            number, lane = int(vehicles["vehicle_number"][row]), lanes[int(vehicles["region_lane"][row])]
            place = float(vehicles["lane_position_m"][row]), float(vehicles["speed_mps"][row])
            steps[time_s][number] = (lane, *place)
    return steps


def assert_equal_steps(context: Context, folder: Path, config: EnvConfig = CONFIG) -> None:
    theirs, ours = run_sumo(context, SEED, folder, config), run_env(context, config)
    lanes = set(read_road(build_net(context.intersection)).lane_ids)
    seen = 0
    for time_s in np.arange(config.warmup_s, config.horizon_s + 0.1, config.step_s).tolist():
        there = {number: place for number, place in theirs[time_s].items() if place[0] in lanes}
        assert set(there) == set(ours[time_s]), f"{context.name} at {time_s} s: other vehicles in the region"
        for number, (lane, position, speed) in there.items():
            got = ours[time_s][number]
            assert got[0] == lane, f"{context.name} at {time_s} s: vehicle {number} is on another lane"
            # The environment reports single precision.
            assert got[1:] == (np.float32(position), np.float32(speed)), f"{context.name} at {time_s} s: {number}"
        seen += len(there)
    assert seen > 100, f"{context.name}: too few vehicles to tell"


@pytest.mark.parametrize("adoption", [0.0, 0.5, 1.0])
def test_uncommanded_episodes_equal_sumos(adoption: float, tmp_path: Path) -> None:
    assert_equal_steps(crossing(adoption=adoption), tmp_path)


def test_uncommanded_episodes_equal_sumos_with_other_warm_up_and_drivers(tmp_path: Path) -> None:
    """With vehicles past the stop line when the warm-up ends."""
    assert_equal_steps(crossing(cv_vehicle="human"), tmp_path, EnvConfig(horizon_s=90.0, warmup_s=40.0))


def test_uncommanded_measured_intersections_equal_sumos(busy: list[Context], tmp_path: Path) -> None:
    """Busy approaches of measured intersections, and whole ones: pockets, permissive lefts, right on red, gates."""
    for context in (busy[0], busy[25].replace(approach=None), busy[60].replace(approach=None)):
        assert_equal_steps(context, tmp_path)


def slopes(context: Context) -> tuple[np.ndarray, np.ndarray]:
    """Return the grade in % of every vehicle in every step, as reported and as SUMO says."""
    import libsumo

    with contextlib.closing(EcoDrivingEnv(context, config=EnvConfig(horizon_s=90.0, warmup_s=25.0))) as env:
        ours, theirs = [], []
        state = env.reset()
        simulation = env.backend.simulation()
        for _ in range(env.config.control_steps - 1):
            frame, state = env.step_and_maybe_reset(defer(state))
            for name, row in simulation.row_of.items():
                ours.append(float(frame["next", "vehicles", "grade_pct"][row]))
                theirs.append(100.0 * np.tan(np.radians(libsumo.vehicle.getSlope(name))))
    return np.array(ours), np.array(theirs)


def test_grade_equals_sumos_slope() -> None:
    """Also for vehicles across a change of grade."""
    ours, theirs = slopes(crossing(grade=0.04))
    assert ours.min() == pytest.approx(-4.0, abs=1e-4) and ours.max() == pytest.approx(4.0, abs=1e-4)
    assert len(np.unique(theirs.round(3))) > 10
    np.testing.assert_allclose(ours, theirs, atol=0.05)


def test_grade_equals_sumos_slope_on_measured_intersections(busy: list[Context]) -> None:
    """Exact except for vehicles that enter, whose rear is still outside the controlled region, and for sharp bends."""
    for context in busy[:3]:
        ours, theirs = slopes(context)
        error = np.abs(ours - theirs)
        assert theirs.std() > 0.1 and len(ours) > 200
        assert (error < 1e-3).mean() > 0.95 and error.mean() < 0.03, context.name
