"""Options of ``python -m izoo.report``."""

from __future__ import annotations

from dataclasses import dataclass

from izoo.errors import CheckedOptions
from izoo.files import make_absolute


@dataclass(frozen=True)
class ReportConfig(CheckedOptions):
    """Options of a report.

    Attributes:
        results: a folder that izoo.evaluate, izoo.train or a benchmark has written; or that of a sweep, with training
            runs at any depth, as izoo.train -m leaves them: then a row for every combination of the options in which
            the runs differ is printed and written to ``sweep.csv`` there, a row per run to ``sweep_runs.csv``, and the
            learning curves to ``sweep.png``. Runs that have not finished are counted and named. The other options are
            refused for a sweep.
        task: show no other task of the folder.
        out: the page; null: ``RESULTS/report.html``.
        title: its title; null: what the folder says.
        replay: show the best and the worst context of every policy, played again beside uncommanded. That takes some
            seconds for each the first time; then they lie in the folder "replays" of the evaluation.
        imports: import policies that are written module:function for that. Say true only of results that you trust.
        partial: accept results that are not complete.
    """

    results: str | None = None
    task: str | None = None
    out: str | None = None
    title: str | None = None
    replay: bool = True
    imports: bool = False
    partial: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        make_absolute(self, "results", "out")
