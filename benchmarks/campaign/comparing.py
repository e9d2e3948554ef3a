"""What the benchmarks that compare policies share: a folder with its settings, and summaries of several tasks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from omegaconf import OmegaConf
from yaml import YAMLError

from izoo.errors import IzooError
from izoo.files import claimed, read_text, write_json, write_text
from izoo.metrics.summary import TRAINING, Summary, summarise_task
from izoo.report.tables import headline, print_summary
from izoo.results.store import check_same

SETTINGS_FILE, SUMMARY_FILE = "settings.yaml", "summary.json"


def check_settings(
    folder: Path, options: Mapping[str, Any], may_differ: Sequence[str] = (), may_grow: Sequence[str] = ()
) -> None:
    """Compare a folder's settings with the options; a folder without any gets them.

    Args:
        folder: of the results; it is made where it is not there.
        options: plain values by name.
        may_differ: options that change no number.
        may_grow: options that may have more values, or a larger one, than before.

    Raises:
        IzooError: the folder holds something else, or the results of other options, which the message names.
    """
    path = folder / SETTINGS_FILE
    wanted = OmegaConf.create({name: value for name, value in options.items() if name not in may_differ})
    with claimed(folder):
        if path.is_file():
            try:
                stored, now = dict(yaml.safe_load(read_text(path))), yaml.safe_load(OmegaConf.to_yaml(wanted))
            except (OSError, ValueError, TypeError, YAMLError) as error:
                raise IzooError(f"cannot read {path}: {str(error).splitlines()[0]}; choose another out.") from error
            grown = {name: now[name] for name in may_grow if _grew(stored.get(name), now.get(name))}
            check_same({**stored, **grown}, now, f"{folder} holds results")
        elif any(folder.iterdir()):
            raise IzooError(f"{folder} is not empty and has no {SETTINGS_FILE}; choose another out.")
        write_text(path, OmegaConf.to_yaml(wanted))


def summaries(folder: Path | None, table: pd.DataFrame, tasks: Iterable[str]) -> list[Summary]:
    """Sum up tasks of a table, each by itself, and write that into a folder, if there is one."""
    found = [summarise_task(table, task) for task in tasks if not task.endswith(TRAINING)]
    if folder is not None:
        write_json(folder / SUMMARY_FILE, found)
    return found


def show(found: Sequence[Summary], verbose: bool = False) -> None:
    """Print the summaries of several tasks; the first one's comes last, and its verdict ends it."""
    for summary in reversed(found[1:]):
        headline(summary).show()
    print_summary(found[0], verbose)


def _grew(old: Any, new: Any) -> bool:
    """Whether a list or a number contains the one before. A list that was empty says something else."""
    if isinstance(old, list) and isinstance(new, list):
        return bool(old) and set(old) <= set(new)
    return isinstance(old, int) and isinstance(new, int) and old <= new
