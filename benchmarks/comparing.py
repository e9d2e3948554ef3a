"""What the benchmarks that compare policies share: a folder with its settings, and plays that its store lacks."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import OmegaConf
from rich.console import Console
from yaml import YAMLError

from izoo.envs.config import EnvConfig
from izoo.errors import IzooError
from izoo.files import read_text, write_json, write_text
from izoo.metrics.figures import FIGURES
from izoo.metrics.pairing import UNCOMMANDED
from izoo.metrics.summary import Summary, summarise
from izoo.report.tables import Cell, headline, print_summary
from izoo.results.rollout import Play, rollout
from izoo.results.store import Store, check_same
from izoo.training.runs import plain_yaml

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
    if path.is_file():
        try:
            stored, now = dict(plain_yaml(read_text(path))), plain_yaml(OmegaConf.to_yaml(wanted))
        except (OSError, ValueError, TypeError, YAMLError) as error:
            raise IzooError(f"cannot read {path}: {str(error).splitlines()[0]}; choose another out.") from error
        grown = {name: now[name] for name in may_grow if _grew(stored.get(name), now.get(name))}
        check_same({**stored, **grown}, now, f"{folder} holds results")
    elif folder.is_dir() and any(folder.iterdir()):
        raise IzooError(f"{folder} is not empty and has no {SETTINGS_FILE}; choose another out.")
    folder.mkdir(parents=True, exist_ok=True)
    write_text(path, OmegaConf.to_yaml(wanted))


def missing(store: Store, plays: Iterable[Play], simulator: str) -> list[Play]:
    """Return the plays whose rows the store lacks."""
    return [p for p in plays if (p.policy, p.train_seed, simulator, p.context.content_hash, p.seed) not in store.done]


def play(
    store: Store, plays: Iterable[Play], policies: Mapping[Any, Any], config: EnvConfig, simulator: str, **options: Any
) -> None:
    """Play what the store lacks, and keep it; ``options`` as :func:`izoo.results.rollout.rollout` takes them."""
    todo = missing(store, plays, simulator)
    with contextlib.closing(rollout(todo, policies, config, simulator=simulator, **options)) as playing:
        for played in playing:
            store.add(played.rows)


def summaries(table: pd.DataFrame, tasks: Iterable[str]) -> list[Summary]:
    """Sum up tasks of a table, each by itself."""
    return [summarise(table[table["task"] == task]) for task in tasks]


def write_summaries(folder: Path, found: Sequence[Summary]) -> None:
    """Write summaries as JSON, a list with one for each task."""
    write_json(folder / SUMMARY_FILE, found)


def show(found: Sequence[Summary], verbose: bool = False) -> None:
    """Print the summaries of several tasks; the first one's comes last, and its verdict ends it."""
    console = Console()
    for summary in reversed(found[1:]):
        console.print(headline(summary).rich(console.width))
    print_summary(found[0], verbose, console)


def figure(summary: Summary, name: str, key: str = "co2_saved", baseline: str = UNCOMMANDED) -> Cell:
    """Return a figure of an entry over a baseline, in the main block of a summary."""
    found = summary["entries"][name]["against"].get(baseline, {}).get(summary["block"])
    estimate = found["figures"][key] if found else dict.fromkeys(("value", "low", "high"))
    declared = FIGURES[key]
    return Cell(estimate["value"], estimate["low"], estimate["high"], declared.unit, declared.digits, signed=True)


def _grew(old: Any, new: Any) -> bool:
    """Whether a list or a number contains the one before. A list that was empty says something else."""
    if isinstance(old, list) and isinstance(new, list):
        return bool(old) and set(old) <= set(new)
    return isinstance(old, int) and isinstance(new, int) and old <= new
