"""Training runs that learn at the same time, each in a process of its own and on its own share of the cores."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import tempfile
from collections.abc import Hashable
from pathlib import Path
from types import TracebackType

from izoo.conf.train_options import TrainConfig
from izoo.console import EXIT_BAD_INPUT, counted, exit_code, survives_lost_output
from izoo.errors import IzooError, UnfinishedError
from izoo.processes import ChildProcess, end_with_parent

_COMMAND = "train"


class ParallelRuns:
    """Training runs beside this process. Those that still learn when the block ends are saved.

    Args:
        at_once: how many may learn at the same time.
    """

    def __init__(self, at_once: int) -> None:
        self._free = shares(at_once)
        self._runs: dict[Hashable, _Run] = {}

    def __enter__(self) -> ParallelRuns:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        going = self.going
        try:
            if going:
                text = f"Saving {counted(len(going), 'training run')}. Ctrl-C stops at once."
                print(f"\n{text}", file=sys.stderr, flush=True)
            for run in going:
                run.dismiss()
            for run in going:
                run.process.wait()
        finally:
            for run in self._runs.values():
                run.kill()

    @property
    def going(self) -> list[_Run]:
        """The runs that learn."""
        return [run for run in self._runs.values() if run.process.poll() is None]

    @property
    def has_room(self) -> bool:
        """Whether one more may begin."""
        return bool(self._free)

    def __contains__(self, name: Hashable) -> bool:
        """Whether the run of this name was begun."""
        return name in self._runs

    def begin(self, name: Hashable, config: TrainConfig, log: Path) -> None:
        """Begin :func:`izoo.training.loop.train` in a new process; what it says is added to the file ``log``."""
        self._runs[name] = _Run(config, log, self._free.pop())

    def is_done(self, name: Hashable) -> bool:
        """Return whether a run has come to its end, and make room for others where some have.

        Raises:
            IzooError, UnfinishedError: this or another one has failed; the message is the last that it said.
        """
        for run in self._runs.values():
            if not run.ended and run.process.poll() is not None:
                run.ended = True
                self._free.append(run.cores)
                run.require_success()
        return self._runs[name].ended


class _Run(ChildProcess):
    """A process that trains; it saves its run and ends when this process is gone.

    Attributes:
        cores: which it runs on.
        ended: whether its end was noticed.
    """

    def __init__(self, config: TrainConfig, log: Path, cores: frozenset[int]) -> None:
        self.cores, self.ended, self._log = cores, False, log
        log.parent.mkdir(parents=True, exist_ok=True)
        self._said_before = log.stat().st_size if log.exists() else 0
        with tempfile.TemporaryFile() as setup, log.open("ab") as output:
            pickle.dump((config, cores), setup)
            setup.flush()
            place, file = f"{__name__}:worker_main", setup.fileno()
            super().__init__(place, file, inherited=(file,), output=output)

    def require_success(self) -> None:
        """Raise what the process said last, unless it came to its end."""
        code = self.process.returncode
        if code == 0:
            return
        said = self._log.read_bytes()[self._said_before :].decode(errors="replace").splitlines()
        last = said[-1].removeprefix(f"izoo {_COMMAND}: ") if said and code > 0 else self.end_text()
        kind = IzooError if code == EXIT_BAD_INPUT else UnfinishedError
        raise kind(f"a training run failed: {last} (all that it said: {self._log})")


def shares(count: int) -> list[frozenset[int]]:
    """Return the cores that each of ``count`` processes gets of those that this one may use.

    Where there are fewer cores than processes, some share one; where the system cannot tell, none is named.
    """
    if not hasattr(os, "sched_getaffinity"):
        return [frozenset()] * count
    cores = sorted(os.sched_getaffinity(0))
    return [frozenset(cores[k::count] or [cores[k % len(cores)]]) for k in range(count)]


def worker_main(parent: int, setup: int) -> None:
    """Train what the parent asks for, and end this process.

    Args:
        parent: descriptor of a socket, which closes when the parent is gone.
        setup: descriptor of a file with the options and the cores.
    """
    config, cores = pickle.loads(os.pread(setup, os.fstat(setup).st_size, 0))
    if cores:
        os.sched_setaffinity(0, cores)

    @survives_lost_output()
    def work() -> int:
        end_with_parent(parent, lambda: os.kill(os.getpid(), signal.SIGTERM))  # which saves the run
        from izoo.training.loop import train  # once the cores are known, which PyTorch counts when it is loaded

        train(config)
        return 0

    sys.exit(exit_code(_COMMAND, work))
