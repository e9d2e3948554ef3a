"""Random full-range actions: no CV runs a red light, and collisions stand beside the uncommanded baseline's."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import pytest

from izoo.contexts.context import Context
from izoo.contexts.source import ContextList
from izoo.envs import EcoDrivingEnv, EnvConfig
from tests.envs.worlds import Driver, at_random, crossing, defer, play, set_action


def totals(env: EcoDrivingEnv, context: Context, seed: int, act: Driver) -> Counter[str]:
    frames = play(env, env.config.control_steps, act, env.reset(context=context, seed=seed))
    sums = frames["next", "metrics", "approach"][-1]
    return Counter({name: float(value.sum()) for name, value in sums.items() if name != "mask"})


def flat_out(tensordict):  # type: ignore[no-untyped-def]
    """Always full acceleration: only SUMO's checks keep this apart from the others and from red lights."""
    action = at_random(0)(tensordict)["agents", "action"]
    return set_action(tensordict, action.clamp(min=2.6))


@pytest.fixture
def env() -> Iterator[EcoDrivingEnv]:
    env = EcoDrivingEnv(crossing(), config=EnvConfig(horizon_s=200.0, warmup_s=5.0, emit=("metrics",)))
    yield env
    env.close()


@pytest.mark.parametrize("act", [at_random(1), flat_out], ids=["random", "flat out"])
def test_no_cv_runs_a_red_light(env: EcoDrivingEnv, act: Driver) -> None:
    """Nor does a human-driven vehicle; and no CV runs into anybody on a simple intersection."""
    counts = totals(env, crossing(adoption=0.5, inflow_vph_per_lane=500.0), 3, act)
    assert counts["agent_steps"] > 1000 and counts["deferred_steps"] < 0.2 * counts["agent_steps"]
    if act is flat_out:
        assert counts["crossed"] > 50
    assert counts["red_crossings_cv"] == counts["red_crossings_hdv"] == 0
    assert counts["collisions_cv"] == 0


def test_red_crossings_are_noticed() -> None:
    """The count can fail: with SUMO's checks switched off by hand, the same driver runs red lights."""
    import libsumo

    env = EcoDrivingEnv(crossing(adoption=1.0), config=EnvConfig(horizon_s=120.0, warmup_s=5.0, emit=("metrics",)))
    try:
        state = env.reset()
        for _ in range(env.config.control_steps - 1):
            for name in env.backend.names.row_of:
                libsumo.vehicle.setSpeedMode(name, 0)
            frame, state = env.step_and_maybe_reset(flat_out(state))
        sums = frame["next", "metrics", "approach"]
        assert sums["red_crossings_cv"].sum() > 0
        assert sums["collisions_cv"].sum() > 0 and frame["next", "metrics", "episode", "collisions"].item() > 0
    finally:
        env.close()


def test_measured_intersections(env: EcoDrivingEnv, dataset: ContextList) -> None:
    busy = sorted(dataset, key=lambda context: -context.flow_vph_per_lane(context.approach or "A"))
    for k, context in enumerate(busy[:24:8]):
        counts = totals(env, context.replace(approach=None), k, at_random(k))
        assert counts["agent_steps"] > 0 and counts["red_crossings_cv"] == 0, context.name


@pytest.mark.slow
def test_two_hundred_episodes_on_all_measured_intersections(dataset: ContextList) -> None:
    """Random actions on every intersection; the counts are printed beside the uncommanded baseline's."""
    names = sorted({context.intersection.name for context in dataset})
    contexts = {context.intersection.name: context.replace(approach=None) for context in dataset}
    env = EcoDrivingEnv(crossing(), config=EnvConfig(emit=("metrics",)))
    commanded, baseline = Counter[str](), Counter[str]()
    try:
        for k in range(200):
            context = contexts[names[k % len(names)]]
            commanded += totals(env, context, 1000 + k, at_random(k))
            baseline += totals(env, context, 1000 + k, defer)
            if (k + 1) % 20 == 0:
                shown = ("crossed", "collisions_cv", "collisions_hdv", "red_crossings_cv", "red_crossings_hdv")
                counts = ", ".join(f"{name} {commanded[name]:.0f} / {baseline[name]:.0f}" for name in shown)
                print(f"{k + 1} episodes, random / uncommanded: {counts}", flush=True)
    finally:
        env.close()
    assert commanded["red_crossings_cv"] == baseline["red_crossings_cv"] == 0
    assert commanded["collisions_cv"] <= baseline["collisions_cv"]
