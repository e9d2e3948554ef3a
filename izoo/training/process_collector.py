"""TorchRL's collector with a process per environment, which notices processes that end or hang."""

from __future__ import annotations

import functools
import signal
import threading
from collections.abc import Iterator, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from izoo.conf.train_options import TrainConfig
from izoo.contexts.source import Schedule
from izoo.errors import IzooError, UnfinishedError
from izoo.training.command_replay import EpisodeHistory
from izoo.training.environments import TrainingEnv
from izoo.training.watchdog import StepWatch, open_counts

WORKER_TRACEBACK = "\n\nWorker traceback:"
"""What TorchRL puts after the message of an error of another process."""


class ProcessCollector(MultiSyncCollector):
    """TorchRL's collector, with errors that say what happened to its processes.

    Attributes:
        watch: over its processes; to be set before the first batch.
    """

    watch: StepWatch

    def iterator(self) -> Iterator[TensorDictBase]:
        """Yield batches ``[N, T]``.

        Raises:
            UnfinishedError: a process has ended, or none took a step and all were ended.
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
            if self.watch.ended:
                raise UnfinishedError(
                    "the processes that collect took no step for env.watchdog_s and were ended; go on with "
                    "resume=RUN_DIR."
                ) from error
            # TorchRL notices too, but then stumbles over the other processes, or over the pipe.
            codes = {number: _exit_code(process) for number, process in enumerate(self.procs)}
            ended = [number for number, code in codes.items() if code not in (None, -signal.SIGTERM)]
            if not ended and "process failed" in str(error):  # TorchRL itself ends the others with SIGTERM
                ended = [number for number, code in codes.items() if code is not None]
            if not ended:
                raise
            raise UnfinishedError(
                f"process {ended[0]} of {self.num_workers} that collect has ended (exit code {codes[ended[0]]}); what "
                "it wrote before says why, unless it was killed. Go on with resume=RUN_DIR."
            ) from error

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


def process_collector(
    config: TrainConfig,
    policy: TensorDictModuleBase,
    schedule: Schedule,
    histories: Sequence[EpisodeHistory],
    frames: int,
) -> ProcessCollector:
    """Return a collector of ``frames`` steps per batch from ``num_workers`` processes.

    Raises:
        IzooError: an environment cannot be made.
    """
    watch = StepWatch(config.num_workers, config.env.watchdog_s)
    try:
        collector = ProcessCollector(
            worker_envs(config, schedule, histories, watch.path),
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


def worker_envs(
    config: TrainConfig, schedule: Schedule, histories: Sequence[EpisodeHistory], counts: Path | None = None
) -> list[functools.partial[EnvBase]]:
    """Return what makes the environment of each worker process.

    Args:
        config, schedule, histories: as for :class:`izoo.training.collectors.BatchSource`.
        counts: file of the workers' counts of steps.
    """
    return [
        functools.partial(worker_env, config, schedule, tuple(histories[worker : worker + 1]), worker, counts)
        for worker in range(config.num_workers)
    ]


def worker_env(
    config: TrainConfig,
    schedule: Schedule,
    histories: Sequence[EpisodeHistory],
    worker: int,
    counts: Path | None = None,
) -> EnvBase:
    """Return the environment of one worker process, and seed that process."""
    # A resumed run draws exploration of its own: where a worker's generator stood is not known here.
    done = sum(history.episode * config.env.decisions + len(history) for history in histories)
    torch.manual_seed((config.seed * 65_537 + worker + done * 1_000_003) % 2**63)
    count = config.num_workers
    env = TrainingEnv(
        schedule,
        config=config.env,
        seed=config.seed,
        worker=worker,
        num_workers=count,
        simulator=config.simulator,
        histories=histories,
    )
    if counts is not None:
        env.steps_taken = open_counts(counts, count)[worker : worker + 1]
    return env
