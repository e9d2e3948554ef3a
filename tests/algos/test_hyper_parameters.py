"""Hyper-parameters out of their range are refused, with their names."""

from typing import Any

import pytest

from izoo.algos.actions.action_modes import ActionSpace
from izoo.algos.learners.ddpg import DDPGConfig
from izoo.algos.learners.graph_ppo import GCRLConfig
from izoo.algos.learners.mappo import MAPPOConfig
from izoo.algos.learners.ppo import PPO, PPOConfig
from izoo.algos.learners.td3 import TD3Config
from izoo.errors import IzooError

BAD: list[tuple[Any, dict[str, list[Any]]]] = [
    (PPOConfig, {"gamma": [1.5], "hidden": [()], "activation": ["sin"], "lr": [-1.0], "epochs": [0]}),
    (PPOConfig, {"clip_epsilon": [1.0], "initial_spread": [0.01, 90.0], "kl_target": [0.0], "kl_to_start": [-1.0]}),
    (PPOConfig, {"max_grad_norm": [0.0], "value_error_clip": [0.0], "warm_start_frames": [0]}),
    (PPOConfig, {"value_coeff": [-0.1], "entropy_coeff": [-0.1], "kl_coeff": [-0.1], "value_norm": ["batch"]}),
    (MAPPOConfig, {"critic_queries": [0], "critic_embedding": [0], "gamma": [2.0]}),
    (GCRLConfig, {"neighbours": [-1], "range_m": [-1.0], "layers": [0], "heads": [0, 3], "hidden": [()]}),
    (DDPGConfig, {"tau": [0.0], "activation": ["sin"], "n_step": [0], "rows_per_frame": [0.0], "hidden": [()]}),
    (TD3Config, {"policy_delay": [0], "target_noise": [-0.1], "stores": ["asked"], "max_grad_norm": [0.0]}),
]


@pytest.mark.parametrize(
    ("config", "name", "value"),
    [(config, name, v) for config, bad in BAD for name, values in bad.items() for v in values],
)
def test_what_is_out_of_range_is_refused_by_name(config: Any, name: str, value: Any) -> None:
    with pytest.raises(IzooError, match=rf"algo\.({name}|hidden)"):
        config(**{name: value})


def test_an_untrained_policy_begins_within_the_bounds_of_its_action() -> None:
    with pytest.raises(IzooError, match="initial_accel"):
        PPO(PPOConfig(initial_accel_mps2=3.0), 5, ActionSpace(-4.5, 2.6))
