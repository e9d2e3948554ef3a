"""What a run says about the time it still needs."""

from __future__ import annotations

import pytest

from izoo.training.progress import ProgressBar, time_left


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


def test_a_resumed_run_counts_its_own_frames_only() -> None:
    assert time_left([(0.0, 800), (10.0, 900)], 1000) == "10 s left"


def test_lines_without_a_terminal_say_how_long_it_takes(capsys: pytest.CaptureFixture[str]) -> None:
    with ProgressBar(100, 50) as bar:
        bar._last_line = 0.0
        bar.update(75, {"return": -3.0, "validation_benefit": 0.031})
        bar.update(100, {"return": -2.0})
    lines = capsys.readouterr().out.splitlines()
    assert "75 / 100  0 s left  return -3.0  validation +3.1%" in lines[0]
    assert "100 / 100  done  return -2.0" in lines[1]
