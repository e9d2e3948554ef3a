"""The folder of a benchmark: what is in it was made under the options and versions that it was begun with."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from yaml import YAMLError

from izoo.benchmarks.generalization_options import SWEPT
from izoo.conf.mapping import to_mapping
from izoo.conf.train_options import TrainConfig
from izoo.errors import IzooError
from izoo.evaluation.folder import differences
from izoo.evaluation.provenance import code_digest
from izoo.files import read_text, write_text
from izoo.reporting.results import SETTINGS_FILE
from izoo.training import runs

MAY_DIFFER = ("out", "num_workers", "runs_at_once", "cache", "human_vehicles", "trained_in")
"""Options that change no number (but for rounding, where a run has fewer cores), so that a benchmark may go on with
others."""
MAY_GROW = ("algos", "seeds", "untrained_seeds", "floors_mps", *SWEPT)
"""Options that may get more values than before; what is there stays."""
NOT_THE_RUN = (*runs.CHANGEABLE, "run_dir")
"""Options of a training run in which a run that is there may differ from the one that is wanted."""
NOT_THE_NUMBERS = ("run_dir", "resume")
"""The same for a run that is taken over whole."""


def check_settings(folder: Path, options: Mapping[str, Any], now: Mapping[str, str]) -> None:
    """Compare a folder's settings with the options and the versions ``now``; an empty folder gets them.

    Besides the versions, ``drivers`` is a digest of the algorithms' own files: entries that are added later drive by
    the same rules as those that are there.

    Raises:
        IzooError: it holds something else, or a benchmark with other settings, which the message names.
    """
    wanted = {**_kept(options, MAY_DIFFER), "versions": with_drivers(now)}
    path = folder / SETTINGS_FILE
    if path.exists():
        stored = _read_settings(path)
        grown = {name: wanted[name] for name in MAY_GROW if _grew(name, stored.get(name), wanted.get(name))}
        differing = differences({**stored, **grown}, wanted)
        if differing:
            raise IzooError(f"{folder} holds a benchmark with other settings ({differing}); give those or another out.")
    elif any(folder.iterdir()):
        raise IzooError(f"{folder} is not empty and has no {SETTINGS_FILE}; choose another out.")
    write_text(path, OmegaConf.to_yaml(OmegaConf.create(wanted)))


def check_run(run_dir: Path, wanted: TrainConfig) -> None:
    """Raise :class:`IzooError` where a run that is there is not the one that is wanted."""
    stored = runs.read_config(run_dir)
    differing = differences(_kept(to_mapping(stored), NOT_THE_RUN), _kept(to_mapping(wanted), NOT_THE_RUN))
    if differing:
        raise IzooError(
            f"the run {run_dir} has other options than the protocol ({differing}); remove that folder to train it "
            "again, or choose another out."
        )


def check_source(folder: Path, now: Mapping[str, str]) -> None:
    """Raise :class:`IzooError` unless the runs of another results folder were trained by the versions ``now``."""
    path = folder / SETTINGS_FILE
    if not path.is_file():
        raise IzooError(f"trained_in: {folder} has no {SETTINGS_FILE}; give a folder that a benchmark wrote.")
    differing = differences(_read_settings(path, "trained_in").get("versions", {}), with_drivers(now))
    if differing:
        raise IzooError(f"trained_in: {folder} was made by other versions ({differing}); leave it out to train again.")


def check_taken(there: Path, wanted: TrainConfig) -> None:
    """Raise :class:`IzooError` where a training run of another results folder is not the very one that is wanted.

    Here those options count as well that may change when a run is resumed.
    """
    stored, mine = (_kept(to_mapping(config), NOT_THE_NUMBERS) for config in (runs.read_config(there), wanted))
    differing = differences(stored, mine)
    if differing:
        raise IzooError(f"trained_in: {there} has other options ({differing}); leave it out to train again.")


def with_drivers(now: Mapping[str, str]) -> dict[str, str]:
    """Return versions with a digest of the algorithms' own files, which decide what drivers do."""
    return {**now, "drivers": code_digest(drivers=True)}


def _kept(values: Mapping[str, Any], without: tuple[str, ...]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name not in without}


def _grew(name: str, old: Any, new: Any) -> bool:
    """Whether a list or a number contains the one before; the first value of a weight would rename all points."""
    if isinstance(new, list):
        return isinstance(old, list) and set(old) <= set(new) and (bool(old) or name not in SWEPT)
    return isinstance(old, int) and isinstance(new, int) and old <= new


def _read_settings(path: Path, option: str = "out") -> dict[str, Any]:
    try:
        stored = runs.plain_yaml(read_text(path, runs.MOST_CONFIG_BYTES))
    except (OSError, YAMLError, ValueError) as error:
        raise IzooError(f"{path} is damaged: {str(error).splitlines()[0]}; choose another {option}.") from error
    if not isinstance(stored, dict):
        raise IzooError(f"{path} is damaged: it is no mapping; choose another {option}.")
    return json.loads(json.dumps(stored))
