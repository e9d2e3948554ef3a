"""Batches of steps from the environments that the options describe."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from izoo.algos.learners.base import Keys
from izoo.conf.train_options import TrainConfig
from izoo.console import workers_ignore_interrupts
from izoo.contexts.source import Schedule
from izoo.envs import simulator_of
from izoo.results import ray_cluster
from izoo.training.batches_in_place import BatchesInPlace
from izoo.training.command_replay import EpisodeHistory
from izoo.training.environments import TrainingBatchEnv, TrainingEnv, random_phases, training_class
from izoo.training.process_collector import ENDLESS, process_collector, worker_envs


class BatchSource:
    """Endless batches ``[N, T]`` from the environments that ``config`` describes; close it when done.

    Args:
        config: options of the run.
        policy: what acts; its parameters may change in place between batches.
        schedule: the episodes.
        histories: the episodes in progress of a run that is resumed, one per environment, where each is stepped in a
            process.
        left_at: where environments side by side stood (:meth:`environments`).
        keeps: the keys that batches of environments side by side hold; ``None``: all that there are.

    Attributes:
        batched: the batches of environments that are stepped side by side in this process; ``None``: they are not.
    """

    def __init__(
        self,
        config: TrainConfig,
        policy: TensorDictModuleBase,
        schedule: Schedule,
        histories: Sequence[EpisodeHistory] = (),
        left_at: Mapping[str, Any] = MappingProxyType({}),
        keeps: Keys | None = None,
    ) -> None:
        frames = config.batch_frames
        simulator = simulator_of(config.simulator)
        self.batched: BatchesInPlace | None = None
        self._collector: BaseCollector | None = None
        self._saves = simulator.saves
        with workers_ignore_interrupts():
            if simulator.batched:
                env = _side_by_side(config, schedule, left_at, keeps)
                self.batched = BatchesInPlace(env, policy, frames // config.environments)
                return
            if config.collector in _APART:
                self._collector = _APART[config.collector](config, policy, schedule, histories, frames)
            else:
                self._collector = in_process(_by_process(config, schedule, histories), policy, frames)
            self._batches: Iterator[TensorDictBase] = iter(self._collector)

    def next(self) -> TensorDictBase:
        """Return the next batch ``[N, T]``, which is valid until the one after it."""
        if self.batched is not None:
            return self.batched.next()
        batch = next(self._batches).copy().exclude("collector")  # what is set in the copy is not there next time
        return batch if batch.ndim == 2 else batch.unsqueeze(0)

    def synchronise(self, policy: TensorDictModuleBase) -> None:
        """Hand changed parameters to collectors that run the policy in other processes."""
        if self._collector is not None and not isinstance(self._collector, Collector):
            self._collector.update_policy_weights_(policy)

    def environments(self) -> dict[str, Any]:
        """Return where the environments stand after the last batch; nothing where they cannot be saved."""
        return self.batched.env.state_dict() if self.batched is not None and self._saves else {}

    def close(self) -> None:
        """Stop the workers; there are no batches any more."""
        if self.batched is not None:
            self.batched.env.close()
        if self._collector is None:
            return
        self._collector.shutdown()
        del self._collector, self._batches
        # TorchRL's parts that hold each other would otherwise be cleaned up when the interpreter ends, and wait there
        # for threads that can no longer start.
        gc.collect()


def _by_process(config: TrainConfig, schedule: Schedule, histories: Sequence[EpisodeHistory]) -> EnvBase:
    """Return environments of which each is stepped in a process; one alone in this process."""
    options: dict[str, Any] = {"config": config.env, "seed": config.seed, "histories": histories}
    if config.collector == "single":
        return TrainingEnv(schedule, simulator=config.simulator, **options)
    return training_class(config.simulator)(config.num_workers, contexts=schedule, shard=0, **options)


def _side_by_side(
    config: TrainConfig, schedule: Schedule, state: Mapping[str, Any], keeps: Keys | None
) -> TrainingBatchEnv:
    count = config.environments
    return training_class(config.simulator)(
        count,
        contexts=schedule,
        config=config.env,
        seed=config.seed,
        shard=0,
        threads=config.twin.threads,
        surrogate=config.twin.surrogate,
        state=state,
        phases=random_phases(count, config.env.decisions, config.seed) if config.staggered else None,
        keeps=keeps,
    )


def in_process(env: EnvBase, policy: TensorDictModuleBase, frames: int) -> Collector:
    """Return a collector of ``frames`` steps per batch from an environment in this process."""
    return Collector(env, policy, frames_per_batch=frames, return_same_td=True, track_traj_ids=False, **ENDLESS)


def _ray_collector(
    config: TrainConfig,
    policy: TensorDictModuleBase,
    schedule: Schedule,
    histories: Sequence[EpisodeHistory],
    frames: int,
) -> BaseCollector:
    ray_cluster.connect()
    from torchrl.collectors.distributed import RayCollector

    collector = RayCollector(
        worker_envs(config, schedule, histories),
        policy,
        frames_per_batch=frames,
        total_frames=2**62,
        exploration_type=ExplorationType.RANDOM,
        trust_policy=True,
        collector_kwargs={"track_traj_ids": False, "auto_register_policy_transforms": False},
        remote_configs=ray_cluster.collecting(),
        sync=True,
    )
    collector.update_policy_weights_(policy)
    return collector


_APART: dict[str, Callable[..., BaseCollector]] = {"multisync": process_collector, "ray": _ray_collector}
"""Collectors that step environments in other processes, by their option ``collector``."""
