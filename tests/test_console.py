"""What a command says about the time it still needs."""

from __future__ import annotations

import pytest

from izoo.console import Progress, duration, time_left
from izoo.training.records import in_short


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


def test_durations_are_words() -> None:
    assert [duration(seconds) for seconds in (5, 600, 7200)] == ["5 s", "10 min", "2.0 h"]


def test_nothing_is_shown_where_nothing_is_wanted(capsys: pytest.CaptureFixture[str]) -> None:
    for bar in (Progress(10, shown=False), Progress(0)):
        with bar:
            bar.update(bar.total)
    assert capsys.readouterr().out == ""
