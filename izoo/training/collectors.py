"""Environments and collectors, as the options choose them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from izoo.conf.options import TrainConfig
from izoo.contexts.context import Context
from izoo.contexts.source import Schedule
from izoo.training.environments import TrainingEnv, TrainingParallelEnv
from izoo.training.interrupt import workers_ignore_interrupts


@dataclass(frozen=True)
class ShiftedSchedule:
    """``schedule`` from its episode number ``first`` on: what a resumed run has not played yet."""

    schedule: Schedule
    first: int

    def __call__(self, episode: int) -> tuple[Context, int]:
        return self.schedule(self.first + episode)


class BatchSource:
    """Endless batches ``[N, T]`` from the environments that ``config`` describes; close it when done.

    Args:
        config: options of the run.
        policy: what acts; its parameters may change in place between batches.
        schedule: the episodes.
    """

    def __init__(self, config: TrainConfig, policy: TensorDictModuleBase, schedule: Schedule) -> None:
        with workers_ignore_interrupts():
            self._collector = _BUILDERS[config.collector.name](config, policy, schedule, frames_per_batch(config))
        self._batches: Iterator[TensorDictBase] = iter(self._collector)

    def next(self) -> TensorDictBase:
        """Return the next batch ``[N, T]``."""
        batch = next(self._batches)
        return batch if batch.ndim == 2 else batch.unsqueeze(0)

    def synchronise(self, policy: TensorDictModuleBase) -> None:
        """Hand changed parameters to collectors that run the policy in other processes."""
        if isinstance(self._collector, MultiSyncCollector):
            self._collector.update_policy_weights_(policy)

    def close(self) -> None:
        """Stop the workers."""
        self._collector.shutdown()


def frames_per_batch(config: TrainConfig) -> int:
    """Return the steps of a batch over all workers: ``algo.frames_per_batch``, as a multiple of their number."""
    workers = 1 if config.collector.name == "single" else config.num_workers
    return -(-config.algo.frames_per_batch // workers) * workers


def _single(config: TrainConfig, policy: TensorDictModuleBase, schedule: Schedule, frames: int) -> Collector:
    return _collector(TrainingEnv(schedule, config=config.env, seed=config.seed), policy, frames)


def _parallel(config: TrainConfig, policy: TensorDictModuleBase, schedule: Schedule, frames: int) -> Collector:
    env = TrainingParallelEnv(config.num_workers, contexts=schedule, config=config.env, seed=config.seed)
    return _collector(env, policy, frames)


def _multisync(
    config: TrainConfig, policy: TensorDictModuleBase, schedule: Schedule, frames: int
) -> MultiSyncCollector:
    makers = [
        functools.partial(_worker_env, config, schedule, worker, config.num_workers)
        for worker in range(config.num_workers)
    ]
    return MultiSyncCollector(
        makers,
        policy,
        frames_per_batch=frames,
        total_frames=-1,
        exploration_type=ExplorationType.RANDOM,
        trust_policy=True,
        auto_register_policy_transforms=False,
        cat_results="stack",
    )


def _worker_env(config: TrainConfig, schedule: Schedule, worker: int, num_workers: int) -> EnvBase:
    torch.manual_seed(config.seed * 65_537 + worker)
    return TrainingEnv(schedule, config=config.env, seed=config.seed, worker=worker, num_workers=num_workers)


def _collector(env: EnvBase, policy: TensorDictModuleBase, frames: int) -> Collector:
    return Collector(
        env,
        policy,
        frames_per_batch=frames,
        total_frames=-1,
        exploration_type=ExplorationType.RANDOM,
        track_traj_ids=False,
        trust_policy=True,
        auto_register_policy_transforms=False,
    )


_BUILDERS: dict[str, Callable[[TrainConfig, TensorDictModuleBase, Schedule, int], Collector | MultiSyncCollector]] = {
    "single": _single,
    "parallel": _parallel,
    "multisync": _multisync,
}
