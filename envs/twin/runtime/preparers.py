"""Episodes that are prepared before their turn: nets, traffic, warm-up; by a thread, or by processes where cores allow.

A new net costs tens of milliseconds of Python. One thread beside those that step is enough for a few environments; a
thousand need more, and threads would wait for each other, so there processes prepare them and hand them over.
"""

from __future__ import annotations

import contextlib
import pickle
import queue
import socket
import threading
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import Future

from izoo.compiling import compiling_once
from izoo.envs.backend import Play
from izoo.envs.config import EnvConfig
from izoo.envs.twin.runtime.batch_step import warm_up_all
from izoo.envs.twin.runtime.episode_setup import Prepared, prepare
from izoo.envs.twin.runtime.scratch import Desk
from izoo.errors import IzooError
from izoo.networks.net.build import TOGETHER, build_nets
from izoo.processes import ChildProcess, receive, send

Answer = Prepared | Exception
_Job = tuple[Callable[[], Play], "Future[Prepared]"]
_Jobs = queue.SimpleQueue["_Job | None"]
_AT_ONCE = 16
"""Episodes that a process gets together, where so many wait: their nets are built in one call."""


class Preparers:
    """Prepares episodes beside the simulation, in the order in which they are submitted.

    Args:
        config: the environments' settings.
        processes: how many; 0: a thread of this process.
    """

    def __init__(self, config: EnvConfig, processes: int = 0) -> None:
        self.processes = processes
        self._jobs: _Jobs = queue.SimpleQueue()
        self._ending = threading.Event()
        serve = _serve if processes == 0 else _serve_by_process
        self._threads = [
            threading.Thread(target=serve, args=(config, self._jobs, self._ending), name="izoo-prepare", daemon=True)
            for _ in range(max(processes, 1))
        ]
        self._begun = False
        self.close = weakref.finalize(self, _close, self._jobs, self._ending, self._threads)
        """Ends it, with what is being prepared; what has not been begun is cancelled."""

    def submit(self, play: Callable[[], Play]) -> Future[Prepared]:
        """Let an episode be prepared; ``play``, which says which, is called in another thread."""
        if not self._begun:
            self._begun = True
            for thread in self._threads:
                thread.start()
        future: Future[Prepared] = Future()
        self._jobs.put((play, future))
        return future


def _close(jobs: _Jobs, ending: threading.Event, threads: Sequence[threading.Thread]) -> None:
    ending.set()
    for _, future in _waiting(jobs, jobs.qsize()):
        future.cancel()
    for _ in threads:
        jobs.put(None)
    for thread in threads:
        if thread.ident is not None and thread is not threading.current_thread():
            thread.join()


def _waiting(jobs: _Jobs, most: int) -> list[_Job]:
    """Return so many of the jobs that wait, or all of them."""
    found: list[_Job] = []
    with contextlib.suppress(queue.Empty):
        while len(found) < most:
            if (job := jobs.get_nowait()) is None:
                jobs.put(None)
                break
            found.append(job)
    return found


def _serve(config: EnvConfig, jobs: _Jobs, ending: threading.Event) -> None:
    """Prepare one episode after the other; each can be cancelled until its turn, but the nets are built together."""
    desk = Desk()
    while (job := jobs.get()) is not None:
        _prepare_in_turn(config, [job, *_waiting(jobs, TOGETHER - 1)], ending, desk)
        del job


def _prepare_in_turn(config: EnvConfig, taken: Sequence[_Job], ending: threading.Event, desk: Desk) -> None:
    nets = []
    for play, future in taken:
        with contextlib.suppress(Exception):  # raised again where that episode is prepared
            nets += [] if future.cancelled() else [play().context.intersection]
    with contextlib.suppress(Exception):  # the same
        build_nets(nets)
    for play, future in taken:
        if ending.is_set():
            future.cancel()
        if future.set_running_or_notify_cancel():
            _settle([future], [_prepared(config, play, desk)])


def _serve_by_process(config: EnvConfig, jobs: _Jobs, ending: threading.Event) -> None:
    """Have episodes prepared by a process, a few at a time; by another one where it is lost."""
    helper = None
    while (job := jobs.get()) is not None:
        running = [job for job in (job, *_waiting(jobs, _AT_ONCE - 1)) if job[1].set_running_or_notify_cancel()]
        helper = _prepare_by(helper, config, running)
        del job, running
    if helper is not None:
        helper.close()


def _prepare_by(helper: _Helper | None, config: EnvConfig, running: Sequence[_Job]) -> _Helper | None:
    """Have episodes prepared by a process, which begins if need be, or here if it is lost; return it if it is there."""
    plays: list[Play] = []
    futures: list[Future[Prepared]] = []
    for play, future in running:
        try:
            plays.append(play())
            futures.append(future)
        except Exception as error:
            future.set_exception(error)
    if not plays:
        return helper
    try:
        helper = helper or _Helper(config)
        answers = helper.prepare(plays)
    except Exception:  # it cannot begin, was killed, for lack of memory perhaps, or its answer cannot be read
        if helper is not None:
            helper.close()
        helper, desk = None, Desk()
        answers = [_prepared(config, fixed(play), desk) for play in plays]
    _settle(futures, answers)
    return helper


def fixed(play: Play) -> Callable[[], Play]:
    """Return what :meth:`Preparers.submit` takes, of an episode that is known."""
    return lambda: play


def _prepared(config: EnvConfig, play: Callable[[], Play], desk: Desk) -> Answer:
    """Return an episode that is ready, or why it cannot be."""
    try:
        return prepare(config, play(), desk)
    except Exception as error:
        return error


def _settle(futures: Sequence[Future[Prepared]], answers: Sequence[Answer]) -> None:
    for future, answer in zip(futures, answers, strict=True):
        if isinstance(answer, Exception):
            future.set_exception(answer)
        else:
            future.set_result(answer)


class _Helper(ChildProcess):
    """A process that prepares episodes; it ends by itself when its parent is gone."""

    def __init__(self, config: EnvConfig) -> None:
        super().__init__("izoo.envs.twin.runtime.preparers:main")
        send(self.socket, pickle.dumps(config))

    def prepare(self, plays: Sequence[Play]) -> list[Answer]:
        """Have episodes prepared.

        Raises:
            OSError, EOFError: the process has ended.
        """
        send(self.socket, pickle.dumps(plays))
        answers: list[Answer] = pickle.loads(receive(self.socket))
        pairs = zip(plays, answers, strict=True)
        return [answer if isinstance(answer, Exception) else answer._replace(play=play) for play, answer in pairs]


def main(descriptor: int) -> None:
    """Prepare what one parent asks for, until it is gone."""
    connection, desk = socket.socket(fileno=descriptor), Desk()
    with contextlib.suppress(EOFError, OSError):
        config = pickle.loads(receive(connection))
        while True:
            plays = pickle.loads(receive(connection))
            with contextlib.suppress(IzooError):  # raised again by those whose net it is
                build_nets([play.context.intersection for play in plays])
            with compiling_once(warm_up_all):
                answers = [_prepared(config, fixed(play), desk) for play in plays]
            send(connection, pickle.dumps([_bare(answer) for answer in answers], pickle.HIGHEST_PROTOCOL))


def _bare(answer: Answer) -> Answer:
    """Leave out what is played, which the parent knows."""
    return answer if isinstance(answer, Exception) else answer._replace(play=None)  # type: ignore[arg-type]
