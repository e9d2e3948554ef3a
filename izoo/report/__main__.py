"""``python -m izoo.report``: results as one HTML page that opens from disk; the runs of a sweep as a table."""

from __future__ import annotations

import dataclasses
import functools
import sys
from dataclasses import dataclass
from pathlib import Path

from izoo.cli.option_command import OptionCommand
from izoo.errors import IzooError
from izoo.files import make_absolute
from izoo.options import CheckedOptions


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


def report(config: ReportConfig) -> Path:
    """Write the page about a folder of results, or the table and the picture of a sweep; return the main file.

    Raises:
        IzooError: options of the page are given for a sweep, which has none.
    """
    from izoo.report import page, sweeps

    if config.results is None:
        raise IzooError("give one folder: python -m izoo.report FOLDER.")
    folder = Path(config.results)
    if not sweeps.is_sweep(folder):
        options = {name: value for name, value in vars(config).items() if name not in ("results", "out")}
        out = None if config.out is None else Path(config.out)
        path = page.write_report(folder, out, note=functools.partial(print, flush=True), **options)
        print(f"Report: {path} ({path.stat().st_size / 1e6:.1f} MB)", flush=True)
        return path
    other = dataclasses.replace(ReportConfig(), results=config.results, imports=config.imports)
    names = [name for name, value in vars(config).items() if value != getattr(other, name)]
    if names:
        raise IzooError(
            f"{folder} is the folder of a sweep, to which {', '.join(names)} cannot apply: its table is written to "
            f"{folder / sweeps.SWEEP_FILE}. Leave {', '.join(names)} out, or give the folder of one run."
        )
    path = sweeps.report(folder, imports=config.imports)
    print(f"Table: {path}", flush=True)
    return path


COMMAND = OptionCommand(
    name="report",
    summary="Write results as one HTML page that opens from disk; of a sweep, show its runs side by side.",
    examples=(
        "izoo.report results/busy_lane out=report.html",
        "izoo.report results/campaign/busy_lane",
        "izoo.report runs/DATE-sweep",
    ),
    config="izoo.report.__main__:ReportConfig",
    work="izoo.report.__main__:report",
    place="results",
)
main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
