"""Environments and collectors, as the options choose them."""

from __future__ import annotations

import functools
import gc
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.process import BaseProcess

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, Collector, MultiSyncCollector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from izoo.conf.train_options import TrainConfig
from izoo.console import workers_ignore_interrupts
from izoo.contexts.context import Context
from izoo.contexts.source import Schedule
from izoo.evaluation import ray_cluster as cluster
from izoo.training.environments import TrainingEnv, TrainingParallelEnv
from izoo.training.past import EpisodePast


@dataclass(frozen=True)
class ShiftedSchedule:
    """``schedule`` from its episode number ``first`` on: what a resumed run has not played yet."""

    schedule: Schedule
    first: int

    def __call__(self, episode: int) -> tuple[Context, int]:
        return self.schedule(self.first + episode)


class ProcessesCollector(MultiSyncCollector):
    """TorchRL's collector with a process per environment, which says plainly which of its processes has ended."""

    def iterator(self) -> Iterator[TensorDictBase]:
        """Yield batches ``[N, T]``.

        Raises:
            RuntimeError: a process has ended.
        """
        try:
            yield from super().iterator()
        except (OSError, RuntimeError, ValueError) as error:
            # TorchRL notices too, but then stumbles over the other processes, or over the pipe, as it may happen.
            for number, process in enumerate(self.procs):
                code = _exit_code(process)
                if code not in (None, -signal.SIGTERM):  # with which TorchRL ends the others
                    raise RuntimeError(
                        f"process {number} of {self.num_workers} that collect has ended (exit code {code}); "
                        "what it wrote before says why, unless it was killed"
                    ) from error
            raise


def _exit_code(process: BaseProcess) -> int | None:
    try:
        return process.exitcode
    except ValueError:  # TorchRL has ended and closed it
        return None


class BatchSource:
    """Endless batches ``[N, T]`` from the environments that ``config`` describes; close it when done.

    Args:
        config: options of the run.
        policy: what acts; its parameters may change in place between batches.
        schedule: the episodes.
        pasts: the episodes in progress of a run that is resumed, one per environment (:func:`num_envs`).
    """

    def __init__(
        self,
        config: TrainConfig,
        policy: TensorDictModuleBase,
        schedule: Schedule,
        pasts: Sequence[EpisodePast] = (),
    ) -> None:
        frames = frames_per_batch(config)
        with workers_ignore_interrupts():
            self._collector = _BUILDERS[config.collector.name](config, policy, schedule, pasts, frames)
        self._batches: Iterator[TensorDictBase] = iter(self._collector)

    def next(self) -> TensorDictBase:
        """Return the next batch ``[N, T]``, which is valid until the one after it."""
        batch = next(self._batches).copy().exclude("collector")  # what is set in the copy is not there next time
        return batch if batch.ndim == 2 else batch.unsqueeze(0)

    def synchronise(self, policy: TensorDictModuleBase) -> None:
        """Hand changed parameters to collectors that run the policy in other processes."""
        if not isinstance(self._collector, Collector):
            self._collector.update_policy_weights_(policy)

    def close(self) -> None:
        """Stop the workers; there are no batches any more."""
        self._collector.shutdown()
        del self._collector, self._batches
        # TorchRL's parts that hold each other would otherwise be cleaned up when the interpreter ends, and wait there
        # for threads that can no longer start.
        gc.collect()


def check_collector(config: TrainConfig) -> None:
    """Raise :class:`IzooError` where the collector that ``config`` names cannot be had here."""
    if config.collector.name == "ray":
        cluster.connect()


def num_envs(config: TrainConfig) -> int:
    """Return how many environments a batch comes from."""
    return 1 if config.collector.name == "single" else config.num_workers


def frames_per_batch(config: TrainConfig) -> int:
    """Return the steps of a batch over all workers: ``algo.frames_per_batch``, as a multiple of their number."""
    workers = num_envs(config)
    return -(-config.algo.frames_per_batch // workers) * workers


def _single(
    config: TrainConfig,
    policy: TensorDictModuleBase,
    schedule: Schedule,
    pasts: Sequence[EpisodePast],
    frames: int,
) -> Collector:
    return _collector(TrainingEnv(schedule, config=config.env, seed=config.seed, pasts=pasts), policy, frames)


def _parallel(
    config: TrainConfig,
    policy: TensorDictModuleBase,
    schedule: Schedule,
    pasts: Sequence[EpisodePast],
    frames: int,
) -> Collector:
    env = TrainingParallelEnv(config.num_workers, contexts=schedule, config=config.env, seed=config.seed, pasts=pasts)
    return _collector(env, policy, frames)


def _multisync(
    config: TrainConfig,
    policy: TensorDictModuleBase,
    schedule: Schedule,
    pasts: Sequence[EpisodePast],
    frames: int,
) -> ProcessesCollector:
    makers = [
        functools.partial(_worker_env, config, schedule, tuple(pasts[worker : worker + 1]), worker, config.num_workers)
        for worker in range(config.num_workers)
    ]
    return ProcessesCollector(
        makers,
        policy,
        frames_per_batch=frames,
        total_frames=-1,
        exploration_type=ExplorationType.RANDOM,
        trust_policy=True,
        auto_register_policy_transforms=False,
    )


def _ray(
    config: TrainConfig,
    policy: TensorDictModuleBase,
    schedule: Schedule,
    pasts: Sequence[EpisodePast],
    frames: int,
) -> BaseCollector:
    cluster.connect()
    from torchrl.collectors.distributed import RayCollector

    makers = [
        functools.partial(_worker_env, config, schedule, tuple(pasts[worker : worker + 1]), worker, config.num_workers)
        for worker in range(config.num_workers)
    ]
    collector = RayCollector(
        makers,
        policy,
        frames_per_batch=frames,
        total_frames=2**62,
        exploration_type=ExplorationType.RANDOM,
        trust_policy=True,
        collector_kwargs={"track_traj_ids": False, "auto_register_policy_transforms": False},
        remote_configs=cluster.WORKER_RESOURCES,
        sync=True,
    )
    collector.update_policy_weights_(policy)
    return collector


def _worker_env(
    config: TrainConfig, schedule: Schedule, pasts: Sequence[EpisodePast], worker: int, num_workers: int
) -> EnvBase:
    # A resumed run draws exploration of its own: where a worker's generator stood is not known here.
    done = sum(past.episode * config.env.control_steps + past.steps for past in pasts)
    torch.manual_seed((config.seed * 65_537 + worker + done * 1_000_003) % 2**63)
    return TrainingEnv(
        schedule, config=config.env, seed=config.seed, worker=worker, num_workers=num_workers, pasts=pasts
    )


def _collector(env: EnvBase, policy: TensorDictModuleBase, frames: int) -> Collector:
    return Collector(
        env,
        policy,
        frames_per_batch=frames,
        total_frames=-1,
        exploration_type=ExplorationType.RANDOM,
        return_same_td=True,
        track_traj_ids=False,
        trust_policy=True,
        auto_register_policy_transforms=False,
    )


_Builder = Callable[[TrainConfig, TensorDictModuleBase, Schedule, Sequence[EpisodePast], int], BaseCollector]
_BUILDERS: dict[str, _Builder] = {
    "single": _single,
    "parallel": _parallel,
    "multisync": _multisync,
    "ray": _ray,
}
