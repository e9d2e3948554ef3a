"""Before its first update a policy that advises is the uncommanded CV, and one that corrects glide is glide."""

import contextlib

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo.algos.actions.action_modes import ActionConfig, AdviseAction, ResidualAction
from izoo.algos.drivers.by_name import make_driver
from izoo.algos.learners.registry import ALGORITHMS, make_algorithm, preset
from izoo.contexts.catalogue import Scenarios
from izoo.contexts.context import Context
from izoo.envs import EcoDrivingEnv, EnvConfig
from tests.envs.worlds import crossing, digest, play, short

MODES: dict[str, tuple[ActionConfig, str]] = {
    "advise": (AdviseAction(), "uncommanded"),
    "residual": (ResidualAction(), "glide"),
}
CONTEXTS, HORIZON_S = 20, 325.0
ADVISING = sorted(set(ALGORITHMS) - {"glide_search"})
"""A search over the settings of a rule commands accelerations, and begins with a rule that drives."""


@pytest.mark.parametrize("mode", MODES)
def test_without_exploration_it_is_the_same_to_the_last_bit(mode: str) -> None:
    action, driver = MODES[mode]
    context = crossing(lane_count=1, phase_count=1)
    with contextlib.closing(EcoDrivingEnv(context, config=short(horizon_s=40.0))) as env:
        policies = {name: make_algorithm(preset(name), action, env.config).policy for name in ADVISING}
        seen = {}
        for name, policy in {driver: make_driver(driver, env.config), **policies}.items():
            with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
                frames = play(env, env.config.control_steps, policy, env.reset(context=context, seed=3))
            seen[name] = digest(frames)
    assert frames["agents", "mask"].any()
    assert len(set(seen.values())) == 1, seen


def grams_per_vehicle(env: EcoDrivingEnv, context: Context, policy: object) -> float:
    """CO2 per vehicle that crossed, over one episode."""
    state: TensorDictBase = env.reset(context=context, seed=11)
    for _ in range(env.config.control_steps):
        state = env.step_lean(policy(state))  # type: ignore[operator]
    metrics = state["metrics", "approach"]
    return float(metrics["emission_g"].sum() / metrics["crossed"].sum().clamp_min(1.0))


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_exploring_it_costs_nothing_that_shows(mode: str) -> None:
    """Twenty approaches, paired: the interval of the difference holds 0, and is narrow enough to mean something."""
    action, driver = MODES[mode]
    everywhere = Scenarios(city="salt_lake_city", season="summer", hour="peak", adoption=1 / 3, split="train")
    contexts = [everywhere[k] for k in np.linspace(0, len(everywhere) - 1, CONTEXTS).astype(int)]
    differences = []
    config = EnvConfig(horizon_s=HORIZON_S, emit=("metrics",))
    with contextlib.closing(EcoDrivingEnv(contexts[0], config=config)) as env:
        torch.manual_seed(0)
        untrained = make_algorithm(preset("ppo"), action, env.config).policy
        reference = make_driver(driver, env.config)
        for context in contexts:
            with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
                ours = grams_per_vehicle(env, context, untrained)
            theirs = grams_per_vehicle(env, context, reference)
            differences.append(100.0 * (ours / theirs - 1.0) if theirs else 0.0)
    mean, error = np.mean(differences), np.std(differences, ddof=1) / CONTEXTS**0.5
    print(f"{mode}: {mean:+.2f} % +- {2.09 * error:.2f} against {driver}")
    assert abs(mean) <= 2.09 * error, "the t interval of 19 degrees of freedom holds 0"
    assert 2.09 * error < 3.0
