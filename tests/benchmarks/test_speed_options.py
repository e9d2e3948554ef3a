"""Options of the speed benchmarks: what cannot be measured is refused, Ctrl-C ends them with its own code."""

from __future__ import annotations

import pytest

from izoo import cli
from izoo.benchmarks import emissions, scaling, throughput


@pytest.mark.parametrize(
    ("main", "words", "message"),
    [
        (throughput.main, ["--workers", "0"], "--workers is 0; one or more"),
        (throughput.main, ["--steps", "199"], "--steps is 199; it must be 200 or more"),
        (throughput.main, ["--scenarios", "lihgt"], "choose from: light, medium, heavy"),
        (scaling.main, ["--steps", "0"], "--steps is 0; one or more"),
        (emissions.main, ["--batch", "0"], "--batch is 0; it must be"),
    ],
)
def test_what_cannot_be_measured_is_refused(main, words, message, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def test_an_interrupt_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted() -> int:
        raise KeyboardInterrupt

    assert cli.exit_code("benchmarks.scaling", interrupted) == 130
    assert capsys.readouterr().err == "izoo benchmarks.scaling: stopped.\n"
    assert cli.exit_code("benchmarks.scaling", lambda: 7) == 7
