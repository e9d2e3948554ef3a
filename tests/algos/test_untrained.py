"""Before its first update a policy that advises is the uncommanded CV, and one that corrects glide is glide."""

import contextlib

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo.algos.actions.action_modes import ActionConfig, AdviseAction, ResidualAction
from izoo.algos.drivers.by_name import make_driver
from izoo.algos.learners.registry import ALGORITHMS, make_algorithm, preset
from izoo.envs import EcoDrivingEnv
from tests.envs.worlds import crossing, digest, play, short

MODES: dict[str, tuple[ActionConfig, str]] = {
    "advise": (AdviseAction(), "uncommanded"),
    "residual": (ResidualAction(), "glide"),
}
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
