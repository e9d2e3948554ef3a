"""What ``python -m izoo.report`` does once its options are known."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from izoo.conf.report_options import ReportConfig
from izoo.errors import IzooError
from izoo.report import page, sweeps


def report(config: ReportConfig) -> Path:
    """Write the page about a folder of results, or the table and the picture of a sweep; return the main file.

    Raises:
        IzooError: options of the page are given for a sweep, which has none.
    """
    folder = Path(str(config.results))
    if sweeps.is_sweep(folder):
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
    path = page.write_report(
        folder,
        None if config.out is None else Path(config.out),
        config.title,
        task=config.task,
        replay=config.replay,
        imports=config.imports,
        partial=config.partial,
        note=lambda text: print(text, flush=True),
    )
    print(f"Report: {path} ({path.stat().st_size / 1e6:.1f} MB)", flush=True)
    return path
