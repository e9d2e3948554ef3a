"""Processes that run a function of izoo apart from this one: started afresh, watched, and gone when their parent is."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

STARTUP_S = 300.0
"""How long the first answer may take: a process imports PyTorch, and may have to compile."""
_LENGTH = struct.Struct("!Q")


class ChildProcess:
    """The parent's handle on a process that runs ``function(descriptor, *arguments)``.

    The descriptor is the child's end of a socket to its parent, which closes when the parent is gone. The process is a
    fresh interpreter that imports what this one can. Unlike those of ``multiprocessing`` it does not run the user's
    script again, so scripts need no ``if __name__ == "__main__"``. It has a session of its own and ignores SIGTERM, so
    neither a terminal's Ctrl-C nor a signal to the whole job reaches it: the parent decides when it ends.

    Args:
        function: ``module:function``.
        arguments: numbers and texts.
        inherited: open descriptors that the process gets under the same numbers.
        output: file that takes what the process prints; ``None``: where this one's goes.
        watchdog_s: how long it may owe an answer, once it has given its first.

    Attributes:
        socket: to the process.
        process: the process.
        patience_s: how long it may owe an answer now.
    """

    def __init__(
        self,
        function: str,
        *arguments: int | str,
        inherited: tuple[int, ...] = (),
        output: BinaryIO | None = None,
        watchdog_s: float = STARTUP_S,
    ) -> None:
        self.socket, child = socket.socketpair()
        module, _, name = function.partition(":")
        call = f"{name}({', '.join(map(repr, (child.fileno(), *arguments)))})"
        program = f"import signal, sys; signal.signal(signal.SIGTERM, signal.SIG_IGN); sys.path[:] = {sys.path!r}; "
        heeds = {"-I": sys.flags.isolated, "-E": sys.flags.ignore_environment, "-s": sys.flags.no_user_site}
        with child:
            flags = [flag for flag, is_set in heeds.items() if is_set]
            self.process = subprocess.Popen(
                [sys.executable, *flags, "-c", f"{program}from {module} import {name}; {call}"],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                pass_fds=(child.fileno(), *inherited),
                start_new_session=True,
            )
        self._watchdog_s, self.patience_s = watchdog_s, max(watchdog_s, STARTUP_S)
        self.asked()

    def asked(self) -> None:
        """Begin to wait for an answer."""
        self._since_s = time.monotonic()

    def answered(self) -> None:
        """Take note of a sign of life."""
        self._since_s, self.patience_s = time.monotonic(), self._watchdog_s

    def patience_left_s(self) -> float:
        """For how long it may still owe its answer."""
        return self._since_s + self.patience_s - time.monotonic()

    def end_text(self) -> str:
        """Return how the process has ended, or that it does not answer."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            code = self.process.wait(max(min(self.patience_left_s(), 5.0), 0.0))
            return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        return f"no answer for {self.patience_s:g} s"

    def dismiss(self) -> None:
        """Let the process know that it should end, by closing the socket, and do not wait for that."""
        self.socket.close()

    def kill(self) -> None:
        """End the process at once, also where it is stopped."""
        self.socket.close()
        self.process.kill()
        self.process.wait()

    def close(self, patience_s: float = 5.0) -> None:
        """Dismiss the process, wait for its end, and kill it if that does not come."""
        self.dismiss()
        try:
            self.process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self.kill()


def processor_s() -> float:
    """Processor seconds of this process and those that it started; without ``/proc``, not of those that still run."""
    if not Path("/proc/self/stat").exists():
        return sum(os.times()[:4])

    def of(process: int | str) -> float:
        try:
            ticks = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11:15]
            children = " ".join(path.read_text() for path in Path(f"/proc/{process}/task").glob("*/children"))
        except OSError:  # it has ended meanwhile
            return 0.0
        return sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK") + sum(map(of, children.split()))

    return of(os.getpid())


def send(connection: socket.socket, message: bytes) -> None:
    """Send a message, behind its length."""
    connection.sendall(_LENGTH.pack(len(message)) + message)


def receive(connection: socket.socket) -> bytearray:
    """Return a message that :func:`send` sent.

    Raises:
        EOFError: the other end is closed.
    """
    (length,) = _LENGTH.unpack(_exactly(connection, _LENGTH.size))
    return _exactly(connection, length)


def _exactly(connection: socket.socket, length: int) -> bytearray:
    message = bytearray(length)
    rest = memoryview(message)
    while rest:
        received = connection.recv_into(rest)
        if not received:
            raise EOFError
        rest = rest[received:]
    return message


def end_with_parent(descriptor: int, end: Callable[[], object] = lambda: os._exit(1)) -> None:
    """In a child: call ``end`` once the parent is gone or has dismissed this process, whatever it is doing."""

    def watch() -> None:
        gone = select.poll()
        gone.register(descriptor, 0)  # a hang-up is always told
        gone.poll()
        end()

    threading.Thread(target=watch, daemon=True).start()
