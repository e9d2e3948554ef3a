"""TorchRL's collector with a process per environment, which notices processes that end or hang."""

from __future__ import annotations

import contextlib
import functools
import signal
import threading
import time
from collections.abc import Iterator, Sequence
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
from izoo.processes import STARTUP_S
from izoo.training.command_replay import EpisodeHistory
from izoo.training.environments import TrainingEnv

ENDLESS: dict[str, Any] = {
    "total_frames": -1,
    "exploration_type": ExplorationType.RANDOM,
    "trust_policy": True,
    "auto_register_policy_transforms": False,
}
"""Options of TorchRL's collectors: batches without end, of actions that are drawn, of a policy that stays as it is."""
WORKER_TRACEBACK = "\n\nWorker traceback:"
"""What TorchRL puts after the message of an error of another process."""
SLOWER = 10.0
"""A batch may take so many times as long as the one before it."""
FIRST_STEP_S = 0.1
"""How long the first batch may take for every step of a process, including those that are replayed."""


class ProcessCollector(MultiSyncCollector):
    """TorchRL's collector, with errors that say what happened to its processes.

    TorchRL notices a process that has ended, but waits forever for one that is stopped or hangs.

    Args:
        watchdog_s: how much longer than :data:`SLOWER` times the last batch one may take; all are ended then.
        first_steps: steps that a process makes until it has its part of the first batch.
        args, options: of TorchRL's collector.
    """

    def __init__(self, *args: Any, watchdog_s: float, first_steps: int, **options: Any) -> None:
        self._watchdog_s, self._hung = watchdog_s, False
        self._patience_s = max(watchdog_s, STARTUP_S) + FIRST_STEP_S * first_steps
        super().__init__(*args, **options)

    def iterator(self) -> Iterator[TensorDictBase]:
        """Yield batches ``[N, T]``.

        Raises:
            UnfinishedError: a process has ended, or a batch took too long and all were ended.
        """
        batches = super().iterator()
        with contextlib.suppress(StopIteration):
            while True:
                begun_s = time.monotonic()
                with self._watched():
                    batch = next(batches)
                self._patience_s = self._watchdog_s + SLOWER * (time.monotonic() - begun_s)
                yield batch

    def update_policy_weights_(self, *args: Any, **options: Any) -> None:
        """Hand changed parameters to the processes.

        Raises:
            UnfinishedError: one does not take them; all are ended.
        """
        with self._watched():
            super().update_policy_weights_(*args, **options)

    @contextlib.contextmanager
    def _watched(self) -> Iterator[None]:
        """End the processes where they do not answer within the block."""
        watch = threading.Timer(self._patience_s, self._end)
        watch.daemon = True
        watch.start()
        try:
            yield
        except (OSError, EOFError, RuntimeError, ValueError) as error:
            if self._hung:
                raise UnfinishedError(
                    f"a batch took longer than {self._patience_s:.0f} s, and the processes that collect were ended; "
                    "raise env.watchdog_s in the run's config.yaml if none of them hung, and go on with resume=RUN_DIR."
                ) from error
            # TorchRL notices too, but then stumbles over the other processes, or over the pipe; these it ends itself.
            codes = {}
            for number, process in enumerate(self.procs):
                with contextlib.suppress(ValueError):  # TorchRL has ended and closed it
                    codes[number] = process.exitcode
            ended = [number for number, code in codes.items() if code not in (None, -signal.SIGTERM)]
            if not ended and "process failed" in str(error):
                ended = [number for number, code in codes.items() if code is not None]
            if not ended:
                raise
            raise UnfinishedError(
                f"process {ended[0]} of {self.num_workers} that collect has ended (exit code {codes[ended[0]]}); what "
                "it wrote before says why, unless it was killed. Go on with resume=RUN_DIR."
            ) from error
        finally:
            watch.cancel()

    def _end(self) -> None:
        self._hung = True
        for process in self.procs:
            with contextlib.suppress(ValueError):  # TorchRL has ended and closed it
                process.kill()


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
    try:
        return ProcessCollector(
            worker_envs(config, schedule, histories),
            policy,
            frames_per_batch=frames,
            watchdog_s=config.env.watchdog_s,
            first_steps=-(-frames // config.num_workers) + max(map(len, histories), default=0),
            **ENDLESS,
        )
    except IzooError as error:
        raise IzooError(str(error).partition(WORKER_TRACEBACK)[0]) from None


def worker_envs(
    config: TrainConfig, schedule: Schedule, histories: Sequence[EpisodeHistory]
) -> list[functools.partial[EnvBase]]:
    """Return what makes the environment of each worker process.

    Args:
        config, schedule, histories: as for :class:`izoo.training.collectors.BatchSource`.
    """
    return [
        functools.partial(worker_env, config, schedule, tuple(histories[worker : worker + 1]), worker)
        for worker in range(config.num_workers)
    ]


def worker_env(config: TrainConfig, schedule: Schedule, histories: Sequence[EpisodeHistory], worker: int) -> EnvBase:
    """Return the environment of one worker process, and seed that process."""
    # A resumed run draws exploration of its own: where a worker's generator stood is not known here.
    done = sum(history.episode * config.env.decisions + len(history) for history in histories)
    torch.manual_seed((config.seed * 65_537 + worker + done * 1_000_003) % 2**63)
    return TrainingEnv(
        schedule,
        config=config.env,
        seed=config.seed,
        worker=worker,
        num_workers=config.num_workers,
        simulator=config.simulator,
        histories=histories,
    )
