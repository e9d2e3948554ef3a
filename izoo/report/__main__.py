"""``python -m izoo.report``: results as one HTML page that opens from disk; the runs of a sweep as a table."""

from __future__ import annotations

import dataclasses
import functools
import sys
from pathlib import Path

from izoo.cli.option_command import OptionCommand
from izoo.conf.report_options import ReportConfig
from izoo.errors import IzooError


def report(config: ReportConfig) -> Path:
    """Write the page about a folder of results, or the table and the picture of a sweep; return the main file.

    Raises:
        IzooError: options of the page are given for a sweep, which has none.
    """
    from izoo.report import page, sweeps

    folder = Path(str(config.results))
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
        "izoo.report results/campaign task=busy_lane",
        "izoo.report runs/DATE-sweep",
    ),
    config="izoo.conf.report_options:ReportConfig",
    work="izoo.report.__main__:report",
    place="results",
)
main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
