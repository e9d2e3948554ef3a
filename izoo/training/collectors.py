"""Environments and collectors, as the options choose them."""

from __future__ import annotations

import functools
import gc
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, Collector, MultiSyncCollector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from izoo.algos.learners.base import Keys
from izoo.conf.train_options import TWIN_ENVS, TrainConfig
from izoo.console import workers_ignore_interrupts
from izoo.contexts.context import Context
from izoo.contexts.source import Schedule
from izoo.envs.config import SPEED, STEP
from izoo.envs.twin.backend import check_settings
from izoo.errors import IzooError, UnfinishedError
from izoo.gpu import check_gpu
from izoo.results import ray_cluster as cluster
from izoo.training.command_replay import EpisodeHistory
from izoo.training.environments import TrainingEnv, TrainingParallelEnv, TrainingTwinEnv, random_phases
from izoo.training.watchdog import Watch, open_counts


@dataclass(frozen=True)
class ShiftedSchedule:
    """``schedule`` from its episode number ``first`` on: what a resumed run has not played yet."""

    schedule: Schedule
    first: int

    def __call__(self, episode: int) -> tuple[Context, int]:
        return self.schedule(self.first + episode)


@dataclass(frozen=True)
class SharedSchedule:
    """``schedule`` for environments in ``blocks`` of equal size, all of which play the same episodes.

    Attributes:
        schedule: the episodes of one block.
        envs: environments in all, a multiple of ``blocks``.
        blocks: how many policies are compared.
    """

    schedule: Schedule
    envs: int
    blocks: int

    def __call__(self, episode: int) -> tuple[Context, int]:
        size = self.envs // self.blocks
        return self.schedule(episode // self.envs * size + episode % size)


WORKER_TRACEBACK = "\n\nWorker traceback:"
"""What TorchRL puts after the message of an error of another process."""


class ProcessesCollector(MultiSyncCollector):
    """TorchRL's collector with a process per environment, which says plainly which of its processes has ended or hangs.

    Attributes:
        watch: over its processes; to be set before the first batch.
    """

    watch: Watch

    def iterator(self) -> Iterator[TensorDictBase]:
        """Yield batches ``[N, T]``.

        Raises:
            UnfinishedError: a process has ended, or has hung and was ended.
        """
        batches = super().iterator()
        pids = [process.pid for process in self.procs]
        try:
            while True:
                with self.watch.over(pids):
                    batch = next(batches)
                yield batch
        except StopIteration:
            return
        except (OSError, RuntimeError, ValueError) as error:
            if self.watch.hung:
                raise UnfinishedError(
                    f"process {self.watch.hung[0]} of {self.num_workers} that collect took no step for env.watchdog_s "
                    "and was ended; go on with resume=RUN_DIR."
                ) from error
            if self.watch.withheld:
                raise UnfinishedError(
                    f"none of {self.num_workers} processes that collect handed over its steps for env.watchdog_s, and "
                    "all were ended; go on with resume=RUN_DIR."
                ) from error
            # TorchRL notices too, but then stumbles over the other processes, or over the pipe, as it may happen.
            for number, process in enumerate(self.procs):
                code = _exit_code(process)
                if code not in (None, -signal.SIGTERM):  # with which TorchRL ends the others
                    raise UnfinishedError(
                        f"process {number} of {self.num_workers} that collect has ended (exit code {code}); what it "
                        "wrote before says why, unless it was killed. Go on with resume=RUN_DIR."
                    ) from error
            raise

    def hand_over(self, policy: TensorDictModuleBase) -> None:
        """Hand changed parameters to the processes; TorchRL would wait forever for one that does not take them.

        Raises:
            UnfinishedError: one does not; all are ended.
        """
        failures: list[Exception] = []

        def update() -> None:
            try:
                self.update_policy_weights_(policy)
            except Exception as error:
                failures.append(error)

        thread = threading.Thread(target=update, daemon=True)
        thread.start()
        thread.join(self.watch.patience_s)
        if thread.is_alive():
            for process in self.procs:
                process.kill()
            raise UnfinishedError(
                "a process that collects took no new weights for env.watchdog_s; go on with resume=RUN_DIR."
            )
        if failures:
            raise failures[0]

    def shutdown(self, timeout: float | None = None, *args: Any, **options: Any) -> None:
        """End the processes."""
        if "watch" in vars(self):  # TorchRL calls this as well, where one of them does not begin
            self.watch.close()
        super().shutdown(timeout, *args, **options)


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
        histories: the episodes in progress of a run that is resumed on SUMO, one per environment (:func:`num_envs`).
        twin: where those of a run on the twin stood (:meth:`environments`).
        keeps: the keys that batches from the twin hold; ``None``: all that there are.
    """

    def __init__(
        self,
        config: TrainConfig,
        policy: TensorDictModuleBase,
        schedule: Schedule,
        histories: Sequence[EpisodeHistory] = (),
        twin: Mapping[str, Any] = MappingProxyType({}),
        keeps: Keys | None = None,
    ) -> None:
        frames = frames_per_batch(config)
        self._twin: TrainingTwinEnv | None = None
        with workers_ignore_interrupts():
            if config.simulator == "twin":
                self._twin = _on_twin(config, schedule, twin, keeps)
                # TorchRL's buffers are made for whole steps; here the observations come for a whole batch.
                self._collector: BaseCollector = _collector(self._twin, policy, frames, use_buffers=False)
            else:
                self._collector = _BUILDERS[config.collector.name](config, policy, schedule, histories, frames)
        self._batches: Iterator[TensorDictBase] = iter(self._collector)

    def next(self) -> TensorDictBase:
        """Return the next batch ``[N, T]``, which is valid until the one after it."""
        batch = next(self._batches).copy().exclude("collector")  # what is set in the copy is not there next time
        if self._twin is not None:
            return self._twin.complete(batch)
        return batch if batch.ndim == 2 else batch.unsqueeze(0)

    def synchronise(self, policy: TensorDictModuleBase) -> None:
        """Hand changed parameters to collectors that run the policy in other processes."""
        if isinstance(self._collector, ProcessesCollector):
            self._collector.hand_over(policy)
        elif not isinstance(self._collector, Collector):
            self._collector.update_policy_weights_(policy)

    @property
    def twin(self) -> TrainingTwinEnv | None:
        """The environments, where they are on the twin."""
        return self._twin

    def environments(self) -> dict[str, Any]:
        """Return where the environments stand after the last batch; nothing where they are not on the twin."""
        return {} if self._twin is None else self._twin.state_dict()

    def close(self) -> None:
        """Stop the workers; there are no batches any more."""
        self._collector.shutdown()
        del self._collector, self._batches
        # TorchRL's parts that hold each other would otherwise be cleaned up when the interpreter ends, and wait there
        # for threads that can no longer start.
        gc.collect()


def check_collector(config: TrainConfig) -> None:
    """Raise :class:`IzooError` where the collector that ``config`` names cannot be had here, or does not suit its
    algorithm.
    """
    if config.env.lane_change:
        raise IzooError(
            "env.lane_change=true asks the policy for lane changes as well, but izoo's learners command accelerations "
            "alone; leave it out."
        )
    if config.env.drain_s:
        raise IzooError(
            f"env.drain_s is {config.env.drain_s:g}, but training episodes end at their horizon; leave it at 0. "
            "Evaluations play their episodes out by themselves."
        )
    if config.simulator == "twin":
        check_settings(config.env)
        if config.twin.surrogate == "cuda":
            check_gpu("twin.surrogate", "torch")
    _check_decisions(config)
    policies, envs = config.algo.candidates, num_envs(config)
    if policies > 1 and (config.simulator != "twin" or envs % policies or config.env.reward.eta != 1.0):
        raise IzooError(
            f"algo={config.algo.name} lets {policies} policies play the same episodes side by side and compares what "
            f"their teams are paid, but simulator is {config.simulator}, num_envs {envs} and env.reward.eta "
            f"{config.env.reward.eta:g}; choose simulator=twin, a multiple of {policies} for num_envs, and "
            "env.reward=fuel_team or env.reward.eta=1."
        )
    if config.collector.name == "ray":
        cluster.connect()


def _check_decisions(config: TrainConfig) -> None:
    """Raise :class:`IzooError` where the options of a run need decisions, or a simulator, that it does not have."""
    algo, decide = config.algo, config.env.decide
    variate = getattr(algo, "control_variate", "none")
    if variate != "none" and config.simulator != "twin":
        raise IzooError(
            f"algo.control_variate={variate} plays every training episode a second time, uncommanded, which only the "
            "twin does beside training; choose simulator=twin, or algo.control_variate=none."
        )
    if algo.candidates > 1 and config.env.action == SPEED:
        raise IzooError(
            f"algo={algo.name} compares policies that command accelerations or give advice, but action is "
            f"{config.action.name}; choose action=direct or advise, and env.action=acceleration."
        )
    if decide == STEP:
        return
    by_step = {
        f"algo={algo.name}": algo.candidates > 1,
        f"action={config.action.name}": config.action.name in ("advise", "residual"),
        "algo.credit=team": getattr(algo, "credit", "agent") == "team",
        "algo.stores=applied": getattr(algo, "stores", "commanded") == "applied" and config.env.action != SPEED,
        "levels.draw=prioritised": config.levels.draw == "prioritised",
    }
    for option, chosen in by_step.items():
        if chosen:
            raise IzooError(f"{option} learns from decisions in every step; set env.decide=step, not {decide}.")


def num_envs(config: TrainConfig) -> int:
    """Return how many environments a batch comes from."""
    if config.simulator == "twin":
        return TWIN_ENVS if config.num_envs is None else config.num_envs
    return 1 if config.collector.name == "single" else config.num_workers


def frames_per_batch(config: TrainConfig) -> int:
    """Return the steps of a batch over all environments: ``algo.frames_per_batch``, as a multiple of their number.

    Where policies are compared, it is an episode of each.
    """
    count = num_envs(config)
    if config.algo.candidates > 1:
        return count * config.env.decisions
    return -(-config.algo.frames_per_batch // count) * count


def _single(
    config: TrainConfig,
    policy: TensorDictModuleBase,
    schedule: Schedule,
    histories: Sequence[EpisodeHistory],
    frames: int,
) -> Collector:
    return _collector(TrainingEnv(schedule, config=config.env, seed=config.seed, histories=histories), policy, frames)


def _parallel(
    config: TrainConfig,
    policy: TensorDictModuleBase,
    schedule: Schedule,
    histories: Sequence[EpisodeHistory],
    frames: int,
) -> Collector:
    env = TrainingParallelEnv(
        config.num_workers, contexts=schedule, config=config.env, seed=config.seed, shard=0, histories=histories
    )
    return _collector(env, policy, frames)


def _on_twin(config: TrainConfig, schedule: Schedule, state: Mapping[str, Any], keeps: Keys | None) -> TrainingTwinEnv:
    count = num_envs(config)
    return TrainingTwinEnv(
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
        batch_steps=frames_per_batch(config) // count,
    )


def _multisync(
    config: TrainConfig,
    policy: TensorDictModuleBase,
    schedule: Schedule,
    histories: Sequence[EpisodeHistory],
    frames: int,
) -> ProcessesCollector:
    workers = config.num_workers
    watch = Watch(workers, frames // workers, config.env.watchdog_s)
    makers = [
        functools.partial(
            _worker_env, config, schedule, tuple(histories[worker : worker + 1]), worker, workers, watch.path
        )
        for worker in range(workers)
    ]
    try:
        collector = ProcessesCollector(
            makers,
            policy,
            frames_per_batch=frames,
            total_frames=-1,
            exploration_type=ExplorationType.RANDOM,
            trust_policy=True,
            auto_register_policy_transforms=False,
        )
    except BaseException as error:
        watch.close()
        if isinstance(error, IzooError):
            raise IzooError(str(error).partition(WORKER_TRACEBACK)[0]) from None
        raise
    collector.watch = watch
    return collector


def _ray(
    config: TrainConfig,
    policy: TensorDictModuleBase,
    schedule: Schedule,
    histories: Sequence[EpisodeHistory],
    frames: int,
) -> BaseCollector:
    cluster.connect()
    from torchrl.collectors.distributed import RayCollector

    makers = [
        functools.partial(
            _worker_env, config, schedule, tuple(histories[worker : worker + 1]), worker, config.num_workers
        )
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
    config: TrainConfig,
    schedule: Schedule,
    histories: Sequence[EpisodeHistory],
    worker: int,
    num_workers: int,
    counts: Path | None = None,
) -> EnvBase:
    # A resumed run draws exploration of its own: where a worker's generator stood is not known here.
    done = sum(past.episode * config.env.decisions + past.steps for past in histories)
    torch.manual_seed((config.seed * 65_537 + worker + done * 1_000_003) % 2**63)
    env = TrainingEnv(
        schedule, config=config.env, seed=config.seed, worker=worker, num_workers=num_workers, histories=histories
    )
    if counts is not None:
        env.steps_taken = open_counts(counts, num_workers)[worker : worker + 1]
    return env


def _collector(env: EnvBase, policy: TensorDictModuleBase, frames: int, use_buffers: bool = True) -> Collector:
    return Collector(
        env,
        policy,
        frames_per_batch=frames,
        total_frames=-1,
        exploration_type=ExplorationType.RANDOM,
        return_same_td=True,
        use_buffers=use_buffers,
        track_traj_ids=False,
        trust_policy=True,
        auto_register_policy_transforms=False,
    )


_Builder = Callable[[TrainConfig, TensorDictModuleBase, Schedule, Sequence[EpisodeHistory], int], BaseCollector]
_BUILDERS: dict[str, _Builder] = {
    "single": _single,
    "parallel": _parallel,
    "multisync": _multisync,
    "ray": _ray,
}
