"""The collector of the training loop yields what TorchRL's own does."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType

from izoo.algos.ppo import PPO
from izoo.algos.ppo_config import PPOConfig
from izoo.envs import EnvConfig
from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2
from izoo.envs.layout import observation_names
from izoo.training.environments import TrainingParallelEnv
from izoo.training.rollouts import RolloutCollector
from tests.envs.worlds import crossing

CONFIG = EnvConfig(emit=("context",), horizon_s=60.0, num_agents=16)
STEPS = 50  # episodes take 70 steps, so that one ends within the second batch


def collect(kind: type[Collector]) -> list[TensorDict]:
    """Two batches ``[2, STEPS]`` of an untrained policy."""
    env = TrainingParallelEnv(2, contexts=crossing(), config=CONFIG)
    torch.manual_seed(0)
    ppo = PPO(PPOConfig(hidden=(8,)), len(observation_names(CONFIG)), ACTION_LOW_MPS2, ACTION_HIGH_MPS2)
    collector = kind(
        env,
        ppo.policy,
        frames_per_batch=2 * STEPS,
        total_frames=-1,
        exploration_type=ExplorationType.RANDOM,
        track_traj_ids=False,
        trust_policy=True,
        auto_register_policy_transforms=False,
    )
    torch.manual_seed(1)
    try:
        batches = iter(collector)
        return [next(batches).clone() for _ in range(2)]
    finally:
        collector.shutdown()


def test_batches_equal_those_of_the_stock_collector() -> None:
    ours, stock = collect(RolloutCollector), collect(Collector)
    assert stock[1]["next", "done"].any() and stock[1]["agents", "mask"].any()
    for one, other in zip(ours, stock, strict=True):
        assert one.shape == other.shape == (2, STEPS)
        keys = set(other.keys(True, True))
        assert set(one.keys(True, True)) == keys
        for key in keys:
            torch.testing.assert_close(one[key], other[key], rtol=0.0, atol=0.0, msg=str(key))
