"""What the collector of the training loop yields, whatever acts and whatever stands around the environment."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo.algos.actions.action_modes import ResidualAction
from izoo.algos.learners.base import ACTION, MASK
from izoo.algos.learners.ddpg import DDPGConfig
from izoo.algos.learners.graph_ppo import GCRLConfig
from izoo.algos.learners.mappo import MAPPOConfig
from izoo.algos.learners.ppo import PPOConfig
from izoo.algos.learners.registry import make_algorithm
from izoo.conf.train_options import TrainConfig
from izoo.contexts.context import Context
from izoo.envs import EnvConfig
from izoo.training import collectors
from izoo.training.environments import TrainingEnv, training_class
from tests.envs.worlds import crossing

GROUPS = ("vehicles", "signal", "context", "reward_vector", "metrics")
CONFIG = EnvConfig(emit=("context",), horizon_s=60.0, num_agents=16)
STEPS = 50  # episodes take 70 steps, so that one ends within the second batch
OPTIONS = {
    "ppo": TrainConfig(algo=PPOConfig(hidden=(8,))),
    "mappo": TrainConfig(algo=MAPPOConfig()),
    "gcrl": TrainConfig(algo=GCRLConfig()),
    "ddpg": TrainConfig(algo=DDPGConfig()),
    "residual": TrainConfig(algo=PPOConfig(hidden=(8,)), action=ResidualAction()),
}


def policy_of(options: TrainConfig) -> TensorDictModuleBase:
    torch.manual_seed(0)
    return make_algorithm(options.algo, options.action, CONFIG).policy


def env_of(workers: int, contexts: Context, config: EnvConfig) -> EnvBase:
    """Environments on SUMO as training has them."""
    if workers == 1:
        return TrainingEnv(contexts, config=config)
    return training_class("sumo")(workers, contexts, config=config)


@contextmanager
def collecting(
    policy: TensorDictModuleBase,
    config: EnvConfig = CONFIG,
    exploration: ExplorationType = ExplorationType.RANDOM,
    workers: int = 1,
) -> Iterator[Collector]:
    """A collector of batches ``[workers, STEPS]``, or ``[STEPS]`` where one environment is in this process."""
    collector = collectors.in_process(env_of(workers, crossing(), config), policy, workers * STEPS)
    collector.exploration_type = exploration
    torch.manual_seed(1)
    try:
        yield collector
    finally:
        collector.shutdown()


def by_hand(name: str, config: EnvConfig, workers: int) -> TensorDict:
    """Two batches of :func:`collecting`, stepped by TorchRL's own loop."""
    policy, contexts = policy_of(OPTIONS[name]), crossing()
    env = env_of(workers, contexts, config)
    frames = []
    try:
        state = env.reset()
        torch.manual_seed(1)
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            for _ in range(2 * STEPS):
                frame, state = EnvBase.step_and_maybe_reset(env, policy(state))
                frames.append(frame.clone())
    finally:
        env.close()
    return torch.stack(frames, -1)


@pytest.mark.parametrize(
    ("name", "workers", "groups"),
    [
        ("gcrl", 1, ()),
        ("residual", 1, ()),
        pytest.param("ppo", 2, ("context",), marks=pytest.mark.slow),
        ("ppo", 1, GROUPS),
    ],
)
def test_batches_are_consecutive_steps(name: str, workers: int, groups: tuple[str, ...]) -> None:
    config = EnvConfig(emit=groups, horizon_s=60.0, num_agents=16)
    expected = by_hand(name, config, workers)
    with collecting(policy_of(OPTIONS[name]), config, workers=workers) as collector:
        found = torch.cat([next(iter(collector)).clone() for _ in range(2)], -1)
    assert found["next", "done"].any() and found[MASK].any()
    assert found.shape == expected.shape and set(found.keys(True, True)) == set(expected.keys(True, True))
    for key in found.keys(True, True):
        torch.testing.assert_close(found[key], expected[key], rtol=0.0, atol=0.0, msg=str(key))


def test_new_weights_are_noticed() -> None:
    policy = policy_of(OPTIONS["ppo"])
    with collecting(policy, exploration=ExplorationType.DETERMINISTIC, workers=2) as collector:
        first = next(iter(collector)).clone()
        with torch.no_grad():
            for parameter in policy.parameters():
                parameter.data = torch.zeros_like(parameter)
        second = next(iter(collector))
        assert (first[ACTION][first[MASK]] != 0.0).all()
        action = second[ACTION][second[MASK]]
        assert len(action) > 0 and (action == action[0]).all()
        assert (second[MASK][:, 1:] == second["next"][MASK][:, :-1])[~second["next", "done"][:, :-1, 0]].all()
