"""Random actions over the full range: no CV runs a red light, and CVs collide no more than uncommanded."""

import contextlib
from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest
from tensordict import TensorDictBase

from izoo.contexts.context import Context
from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.networks.clock import GREEN, RED, YELLOW
from izoo.networks.road import RoadNet
from tests.envs.worlds import Driver, at_random, crossing, defer, set_action
from tests.networks.test_clock import signal_links


def totals(env: EcoDrivingEnv, context: Context, seed: int, act: Driver) -> Counter[str]:
    state = env.reset(context=context, seed=seed)
    while not state["done"].item():
        state = env.step_lean(act(state))
    sums = state["metrics", "approach"]
    return Counter({name: float(value.sum()) for name, value in sums.items() if name != "mask"})


def flat_out(tensordict):  # type: ignore[no-untyped-def]
    """Always full acceleration: only SUMO's checks prevent collisions and red-light violations."""
    action = at_random(0)(tensordict)["agents", "action"]
    return set_action(tensordict, action.clamp(min=2.6))


@pytest.fixture
def env() -> Iterator[EcoDrivingEnv]:
    env = EcoDrivingEnv(crossing(), config=EnvConfig(horizon_s=200.0, warmup_s=5.0, emit=("metrics",)))
    yield env
    env.close()


@pytest.mark.parametrize("act", [at_random(1), flat_out], ids=["random", "flat out"])
def test_no_cv_runs_a_red_light(env: EcoDrivingEnv, act: Driver) -> None:
    """Nor does a human-driven vehicle, and no CV collides on a simple intersection."""
    counts = totals(env, crossing(adoption=0.5, inflow_vph_per_lane=500.0), 3, act)
    assert counts["agent_steps"] > 1000 and counts["deferred_steps"] < 0.2 * counts["agent_steps"]
    if act is flat_out:
        assert counts["crossed"] > 50
    assert counts["red_crossings_cv"] == counts["red_crossings_hdv"] == 0
    assert counts["collisions_cv"] == 0


def test_red_crossings_are_noticed() -> None:
    """With SUMO's checks switched off, the same driver runs red lights."""
    import libsumo

    with contextlib.closing(
        EcoDrivingEnv(crossing(adoption=1.0), config=EnvConfig(horizon_s=120.0, warmup_s=5.0, emit=("metrics",)))
    ) as env:
        state = env.reset()
        for _ in range(env.config.control_steps - 1):
            for name in env.backend.simulation().row_of:
                libsumo.vehicle.setSpeedMode(name, 0)
            frame, state = env.step_and_maybe_reset(flat_out(state))
        sums = frame["next", "metrics", "approach"]
        assert sums["red_crossings_cv"].sum() > 0
        assert sums["collisions_cv"].sum() > 0 and frame["next", "metrics", "episode", "collisions"].item() > 0


def rush(tensordict: TensorDictBase) -> TensorDictBase:
    """Drive on at a moderate speed, so that many arrive at the stop line as the signal switches."""
    speed = 15.0 * tensordict["agents", "observation"][..., :1]
    return set_action(tensordict, (6.0 - speed).clamp(-4.5, 2.6))


def letters_of(road: RoadNet, state: str) -> np.ndarray:
    """Return the colour ``[P, Q]`` that SUMO's signal shows to each movement."""
    colour = np.full(road.movement_turn.shape, RED)
    for (p, q), links in signal_links(road).items():
        colour[p, q] = min({"G": GREEN, "g": GREEN, "y": YELLOW}.get(state[link], RED) for link in links)
    return colour


def test_red_crossings_count_by_the_signal_during_the_step() -> None:
    """With greens that end between two steps, it is the signal that SUMO shows after the step."""
    import libsumo

    context = crossing(adoption=1.0, inflow_vph_per_lane=500.0, green_s=20.3, offset_s=2.1)
    config = EnvConfig(horizon_s=400.0, warmup_s=5.0, step_s=1.0)
    shown: list[np.ndarray] = []
    invented = 0
    for simulator in ("sumo", "twin"):
        with contextlib.closing(EcoDrivingEnv(context, config=config, simulator=simulator, worker=0)) as env:
            state = env.reset()
            road, vehicles = env.road, state["vehicles"]
            early = set(vehicles["vehicle_number"][vehicles["present"]].tolist())
            on_red, before = 0, np.full(road.movement_turn.shape, GREEN)
            for step in range(config.control_steps - 1):
                frame, state = env.step_and_maybe_reset(rush(state))
                if simulator == "sumo":
                    shown.append(letters_of(road, libsumo.trafficlight.getRedYellowGreenState("TL")))
                here, there = frame["vehicles"], frame["next", "vehicles"]
                same = here["present"] & there["present"] & (here["vehicle_number"] == there["vehicle_number"])
                crossing_now = same & (here["location"] == 0) & (there["location"] > 0)
                for row in crossing_now.nonzero().flatten().tolist():
                    movement = int(here["approach"][row]), int(here["exit"][row])
                    counted = int(here["vehicle_number"][row]) not in early
                    on_red += counted and shown[step][movement] == RED
                    invented += counted and shown[step][movement] != RED and before[movement] == RED
                before = shown[step]
            sums = frame["next", "metrics", "approach"]
            assert sums["crossed"].sum() > 100
            assert sums["red_crossings_cv"].sum() == on_red
    assert invented > 0


def test_measured_intersections(env: EcoDrivingEnv, busy: list[Context]) -> None:
    for k, context in enumerate(busy[:24:8]):
        counts, baseline = (totals(env, context.replace(approach=None), k, act) for act in (at_random(k), defer))
        assert counts["agent_steps"] > 0 and counts["red_crossings_cv"] == 0, context.name
        assert counts["collisions_cv"] <= baseline["collisions_cv"], context.name
