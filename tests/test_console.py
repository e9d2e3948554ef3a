"""What a command says about the time it still needs, and what becomes of it where nothing more can be said."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from izoo.console import Progress, duration, time_left
from izoo.training.loggers import in_short


@pytest.mark.parametrize(
    ("seconds", "frames", "text"),
    [
        (10.0, 500, "10 s left"),
        (10.0, 10, "16 min left"),
        (10.0, 1, "2.8 h left"),
        (10.0, 0, "time left unknown"),
        (10.0, 1000, "done"),
    ],
)
def test_time_left_follows_the_speed_so_far(seconds: float, frames: int, text: str) -> None:
    assert time_left([(5.0, 0), (5.0 + seconds, frames)], 1000) == text
    assert [duration(seconds) for seconds in (5, 600, 7200)] == ["5 s", "10 min", "2.0 h"]


def test_lines_without_a_terminal_say_how_long_it_takes(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress(100, 50, "frames") as bar:
        bar._last_line = float("-inf")
        bar.update(75, in_short({"return": -3.0, "validation_co2_saved": 3.1}))
        bar.update(76, "too soon for a line")
        bar.update(100)
    lines = capsys.readouterr().out.splitlines()
    assert "75 / 100 frames  0 s left  return -3.0  validation +3.1 %" in lines[0]
    assert lines[1:] == ["       100 / 100 frames  done"]


def test_a_validation_stands_with_its_interval_where_it_has_one() -> None:
    row = {"validation_co2_saved": 3.1, "validation_co2_saved_low": -1.04, "validation_co2_saved_high": 7.2}
    text = in_short({**row, "validation_delay_change_s": 1.0, "frames_per_s": 12.3})
    assert text == "12 frames/s  validation +3.1 % [-1.0, 7.2]  delay +1.0 s"


@contextlib.contextmanager
def unread() -> Iterator[tuple[int, Callable[[], object]]]:
    reading, writing = os.pipe()
    yield writing, lambda: os.close(reading)
    os.close(writing)


@contextlib.contextmanager
def full() -> Iterator[tuple[int, Callable[[], object]]]:
    with open("/dev/full", "wb") as file:  # noqa: PTH123
        yield file.fileno(), lambda: None


LOST = {"nobody reads": unread, "full disk": full}
"""How output is lost: what a process is to write to, and what happens to it then."""
WORK = """
import sys, time
from pathlib import Path
from izoo.console import Progress, exit_code, survives_lost_output

@survives_lost_output()
def work():
    print("begins", flush=True)
    while not Path(sys.argv[1], "lost").exists():
        time.sleep(0.01)
    with Progress(3) as bar:
        for k in range(3):
            bar.update(k + 1)
            print("a line", file=sys.stderr)
            time.sleep(0.05)
    Path(sys.argv[1], "done").touch()
    print("ends")
    return 0

sys.exit(exit_code("work", work))
"""
TALK = """
import sys, time
from pathlib import Path
from izoo.console import exit_code

def talk():
    while not Path(sys.argv[1], "lost").exists():
        time.sleep(0.01)
    print("all that it is for")
    return 0

sys.exit(exit_code("talk", talk))
"""


def ended(program: str, folder: Path, output: int, error: int, lose: Callable[[], object]) -> int:
    """Run a program that loses its output after a moment; return its exit code."""
    command = [sys.executable, "-c", program, str(folder)]
    process = subprocess.Popen(command, stdout=output, stderr=error, start_new_session=True)
    time.sleep(0.3)
    lose()
    (folder / "lost").touch()
    return process.wait(60)


@pytest.mark.parametrize(("how", "both"), [*((how, False) for how in LOST), ("nobody reads", True)])
def test_work_that_leaves_files_goes_on_without_its_output(how: str, both: bool, tmp_path: Path) -> None:
    with LOST[how]() as (output, lose), (tmp_path / "errors").open("wb") as errors:
        assert ended(WORK, tmp_path, output, output if both else errors.fileno(), lose) == 0
        assert (tmp_path / "done").exists()
    said = (tmp_path / "errors").read_text()
    assert "Traceback" not in said and "Exception" not in said
    assert both or said.count("izoo: the output is lost from here on (") == 1


FULL = "izoo talk: cannot write the output: No space left on device.\n"


@pytest.mark.parametrize(("how", "code", "said"), [("nobody reads", 0, ""), ("full disk", 1, FULL)])
def test_a_command_that_only_talks_ends_with_its_output(how: str, code: int, said: str, tmp_path: Path) -> None:
    with LOST[how]() as (output, lose), (tmp_path / "errors").open("wb") as errors:
        assert ended(TALK, tmp_path, output, errors.fileno(), lose) == code
    assert (tmp_path / "errors").read_text() == said


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_characters_that_a_terminal_cannot_spell_are_escapes(encoding: str) -> None:
    text = "50 % \u2192 \udc80"
    program = f"import sys; from izoo.console import exit_code; sys.exit(exit_code('x', lambda: print({text!r}) or 0))"
    environment = {**os.environ, "PYTHONIOENCODING": f"{encoding}:strict"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, env=environment)
    assert done.returncode == 0 and done.stderr == b""
    assert done.stdout.decode(encoding).strip() == text.encode(encoding, "backslashreplace").decode(encoding)
