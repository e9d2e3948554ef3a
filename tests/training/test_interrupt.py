"""Ctrl-C while worker processes start: it reaches this process, late but surely, and none of them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from izoo.console import graceful_interrupt, workers_ignore_interrupts

CHILD = "import sys; print('up', flush=True); sys.stdin.readline(); print('alive')"


def test_an_interrupt_while_workers_start_is_kept(capsys: pytest.CaptureFixture[str]) -> None:
    with graceful_interrupt() as interrupt:
        with workers_ignore_interrupts():
            os.kill(os.getpid(), signal.SIGINT)
        assert interrupt.requested
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert "in good order" in capsys.readouterr().err


def test_workers_do_not_see_interrupts() -> None:
    with workers_ignore_interrupts():
        child = subprocess.Popen(
            [sys.executable, "-c", CHILD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
    assert child.stdout is not None and child.stdout.readline() == b"up\n"
    child.send_signal(signal.SIGINT)
    answer, complaints = child.communicate(b"\n", timeout=30)
    assert (answer, complaints, child.returncode) == (b"alive\n", b"", 0)


def test_processes_of_multiprocessing_do_not_see_interrupts() -> None:
    """They start a tracker of their own first, which must not undo the block."""
    program = (
        "import multiprocessing, os, signal, time\n"
        "from izoo.console import workers_ignore_interrupts\n"
        "if __name__ == '__main__':\n"
        "    with workers_ignore_interrupts():\n"
        "        child = multiprocessing.get_context('spawn').Process(target=time.sleep, args=(0.5,))\n"
        "        child.start()\n"
        "    os.kill(child.pid, signal.SIGINT)\n"
        "    child.join()\n"
        "    print('exit code', child.exitcode)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("exit code 0\n", "")
