"""What ``python -m izoo.report`` does once its options are known."""

from __future__ import annotations

from pathlib import Path

from izoo.conf.report_options import ReportConfig
from izoo.reporting import page, sweeps


def report(config: ReportConfig, given: frozenset[str] = frozenset()) -> Path:
    """Write the page about a folder of results, or the table and the picture of a sweep; return the main file.

    Args:
        config: the options.
        given: unused; commands share one signature.
    """
    folder = Path(str(config.results)).expanduser()
    if sweeps.is_sweep(folder):
        path = sweeps.report(folder)
        print(f"Table: {path}", flush=True)
        return path
    path = page.write_report(
        folder,
        None if config.out is None else Path(config.out).expanduser(),
        config.title,
        replay=config.replay,
        imports=config.imports,
        partial=config.partial,
        note=lambda text: print(text, flush=True),
    )
    print(f"Report: {path} ({path.stat().st_size / 1e6:.1f} MB)", flush=True)
    return path
