"""The collector of the training loop yields what TorchRL's own does."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType

from izoo.algos.action import ResidualAction
from izoo.algos.base import ACTION, MASK, acts_in_place
from izoo.algos.ddpg_config import DDPGConfig
from izoo.algos.gaussian import CompiledPolicy
from izoo.algos.ppo_config import GCRLConfig, MAPPOConfig, PPOConfig
from izoo.conf.train_options import TrainConfig
from izoo.envs import EnvConfig
from izoo.envs.config import KEEP_LANE
from izoo.envs.mdp.frame import observation_names
from izoo.errors import IzooError
from izoo.training.environments import TrainingEnv, TrainingParallelEnv
from izoo.training.rollouts import RolloutCollector
from izoo.training.runs import make_algorithm
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
    return make_algorithm(options, len(observation_names(CONFIG))).policy


@contextmanager
def collecting(
    kind: type[Collector],
    policy: TensorDictModuleBase,
    config: EnvConfig = CONFIG,
    exploration: ExplorationType = ExplorationType.RANDOM,
    workers: int = 1,
) -> Iterator[Collector]:
    """A collector of batches ``[workers, STEPS]``, or ``[STEPS]`` where one environment is in this process."""
    contexts = crossing()
    env = TrainingParallelEnv(workers, contexts, config=config) if workers > 1 else TrainingEnv(contexts, config=config)
    collector = kind(
        env,
        policy,
        frames_per_batch=workers * STEPS,
        total_frames=-1,
        exploration_type=exploration,
        return_same_td=True,
        track_traj_ids=False,
        trust_policy=True,
        auto_register_policy_transforms=False,
    )
    torch.manual_seed(1)
    try:
        yield collector
    finally:
        collector.shutdown()


def assert_same(one: TensorDictBase, other: TensorDictBase) -> None:
    keys = set(other.keys(True, True))
    assert one.shape == other.shape and set(one.keys(True, True)) == keys
    for key in keys:
        torch.testing.assert_close(one[key], other[key], rtol=0.0, atol=0.0, msg=str(key))


def assert_collects_the_same(options: TrainConfig, **settings: object) -> list[TensorDict]:
    """Compare two batches with those of TorchRL's collector; return them."""
    batches: list[list[TensorDict]] = []
    for kind in (RolloutCollector, Collector):
        with collecting(kind, policy_of(options), **settings) as collector:  # type: ignore[arg-type]
            batches.append([next(iter(collector)).clone() for _ in range(2)])
    ours, stock = batches
    assert stock[1]["next", "done"].any() and stock[1][MASK].any()
    for one, other in zip(ours, stock, strict=True):
        assert_same(one, other)
    return ours


@pytest.mark.parametrize("name", OPTIONS)
def test_batches_equal_those_of_the_stock_collector(name: str) -> None:
    assert_collects_the_same(OPTIONS[name], workers=2 if name == "ppo" else 1)


@pytest.mark.parametrize("workers", [1, 2])
def test_batches_without_exploration_and_with_all_groups(workers: int) -> None:
    config = EnvConfig(emit=GROUPS, horizon_s=60.0, num_agents=16)
    settings = {"config": config, "exploration": ExplorationType.DETERMINISTIC, "workers": workers}
    (batch, _) = assert_collects_the_same(OPTIONS["ppo"], **settings)
    assert batch.shape[-1] == STEPS and batch["vehicles", "present"].any()


class Constant(CompiledPolicy):
    """Calls do something else than the policy that it is made of."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        super().forward(tensordict)
        return tensordict.set(ACTION, torch.full_like(tensordict.get(ACTION), 1.25))


def test_which_policies_act_in_place() -> None:
    found = {name for name, options in OPTIONS.items() if acts_in_place(policy_of(options))}
    assert found == {"ppo", "mappo", "gcrl"}
    policy = policy_of(OPTIONS["ppo"])
    policy.__class__ = Constant
    assert not acts_in_place(policy)
    with collecting(RolloutCollector, policy) as collector:
        assert (next(iter(collector))[ACTION] == 1.25).all()


def test_new_weights_and_moved_memory_are_noticed() -> None:
    policy = policy_of(OPTIONS["ppo"])
    with collecting(RolloutCollector, policy, exploration=ExplorationType.DETERMINISTIC, workers=2) as collector:
        first = next(iter(collector)).clone()
        with torch.no_grad():
            for parameter in policy.parameters():
                parameter.data = torch.zeros_like(parameter)
        collector._final_rollout.share_memory_()
        second = next(iter(collector))
        assert (first[ACTION][first[MASK]] != 0.0).all()
        action = second[ACTION][second[MASK]]
        assert len(action) > 0 and (action == action[0]).all()
        assert (second[MASK][:, 1:] == second["next"][MASK][:, :-1])[~second["next", "done"][:, :-1, 0]].all()


class Careless(TensorDictModuleBase):
    """Answers with a TensorDict of its own, and leaves marks in the one that it was given."""

    def __init__(self) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [("agents", "observation")], [ACTION]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        speed = tensordict.get(("agents", "observation"))[..., :1]
        tensordict.set(("agents", "observation"), torch.full_like(speed, torch.nan))
        tensordict.set(("agents", "mark"), speed)
        return TensorDict({"agents": {"action": 1.0 - speed}}, tensordict.batch_size)


def test_what_a_policy_does_to_its_input_stays_there() -> None:
    with collecting(RolloutCollector, Careless()) as collector:
        for _ in range(2):
            batch = next(iter(collector))
            assert ("agents", "mark") not in batch.keys(True)
            torch.testing.assert_close(batch[ACTION], 1.0 - batch["agents", "observation"][..., :1])


class Changing(TensorDictModuleBase):
    """Drives on, and changes lanes to ``lane_change``."""

    def __init__(self, lane_change: int) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [MASK], [ACTION, ("agents", "lane_change")]
        self.lane_change = lane_change

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get(MASK)
        tensordict.set(("agents", "lane_change"), torch.full(mask.shape, KEEP_LANE).masked_fill(mask, self.lane_change))
        return tensordict.set(ACTION, torch.ones(*mask.shape, 1))


def test_lane_changes_are_commanded_and_checked() -> None:
    config = EnvConfig(horizon_s=60.0, num_agents=16, lane_change=True)
    batches = []
    for kind in (RolloutCollector, Collector):
        with collecting(kind, Changing(2), config) as collector:
            batches.append(next(iter(collector)).clone())
    assert_same(*batches)
    illegal = pytest.raises(IzooError, match=r"'lane_change'\) is torch.int64 of shape .* with the values")
    with collecting(RolloutCollector, Changing(7), config) as collector, illegal:
        list(zip(range(2), collector, strict=False))


@pytest.mark.parametrize("name", OPTIONS)
def test_policies_that_do_not_change_lanes_are_refused_where_they_must(name: str) -> None:
    config = EnvConfig(horizon_s=60.0, num_agents=16, lane_change=True)
    refused = pytest.raises(IzooError, match=r"'lane_change'\) is missing")
    with collecting(RolloutCollector, policy_of(OPTIONS[name]), config) as collector, refused:
        next(iter(collector))


class Shrinking(TensorDictModuleBase):
    """What it answers besides actions becomes smaller."""

    def __init__(self) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [MASK], [ACTION, ("agents", "value")]
        self.calls = 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        mask, self.calls = tensordict.get(MASK), self.calls + 1
        tensordict.set(("agents", "value"), torch.zeros(*mask.shape, 2 if self.calls < 5 else 1))
        return tensordict.set(ACTION, torch.ones(*mask.shape, 1))


def test_answers_do_not_change_their_shape() -> None:
    refused = pytest.raises(IzooError, match=r"'value'\) is of shape \[16, 1\] .* it was of shape \[16, 2\]")
    with collecting(RolloutCollector, Shrinking()) as collector, refused:
        next(iter(collector))


class Deferring(TensorDictModuleBase):
    """Leaves every other slot to SUMO, where the flags are not all 0, and brakes with the others."""

    def __init__(self, kind: torch.dtype, flag: int) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [MASK], [ACTION, ("agents", "defer")]
        self.kind, self.flag = kind, flag

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get(MASK)
        flags = (torch.arange(mask.shape[-1]) % 2 * self.flag).expand(mask.shape).to(self.kind)
        tensordict.set(("agents", "defer"), flags)
        return tensordict.set(ACTION, -torch.ones(*mask.shape, 1))


def test_flags_of_any_type_defer() -> None:
    seen = []
    for kind, flag in ((torch.bool, 1), (torch.float32, 3), (torch.bool, 0)):
        with collecting(RolloutCollector, Deferring(kind, flag)) as collector:
            seen.append(next(iter(collector))["agents", "observation"].clone())
    assert torch.equal(seen[0], seen[1]) and not torch.equal(seen[0], seen[2])


def test_a_rollout_needs_running_episodes() -> None:
    with collecting(RolloutCollector, policy_of(OPTIONS["ppo"]), workers=2) as collector:
        collector.env._started = False
        with pytest.raises(IzooError, match=r"before reset\(\)"):
            next(iter(collector))


class Misshapen(TensorDictModuleBase):
    """Its flags are of a wrong shape."""

    def __init__(self) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [MASK], [ACTION, ("agents", "defer")]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get(MASK)
        tensordict.set(("agents", "defer"), mask.unsqueeze(-1).expand(*mask.shape, 2))
        return tensordict.set(ACTION, torch.ones(*mask.shape, 1))


def test_commands_of_a_wrong_shape_are_refused() -> None:
    refused = pytest.raises(IzooError, match=r"'defer'\) is of shape \[16, 2\]")
    with collecting(RolloutCollector, Misshapen()) as collector, refused:
        next(iter(collector))


def test_a_worker_lost_in_a_batch() -> None:
    """Its step is reported as truncated, from and to the same state; the other goes on."""
    with collecting(RolloutCollector, policy_of(OPTIONS["ppo"]), workers=2) as collector:
        next(iter(collector))
        os.kill(collector.env.backend._workers[1].process.pid, signal.SIGKILL)
        batch = next(iter(collector))
        assert batch["next", "truncated"][1, 0].all() and not batch["next", "truncated"][0, 0].any()
        following = batch["next"]
        for key in (MASK, ("agents", "observation"), ("agents", "vehicle")):
            assert torch.equal(following[key][1, 0], batch[key][1, 0])
        assert batch["context", "episode"][:, 1].flatten().tolist() == [0, 3]
