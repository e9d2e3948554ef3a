"""Drivers who follow leaders: what the calibration works on, made of files that were read and checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from izoo.drivers.checks import Problem, check_units, time_step
from izoo.drivers.recorded_pairs import CLASSES, read_pairs
from izoo.errors import IzooError, check_range

SIMULATOR_STEP_S = 0.5
MIN_DRIVERS, MIN_STEPS = 5, 20
MAX_STEPS = 1200
"""Of one driver: ten minutes at 0.5 s."""
BOTH_STAND_MPS = 0.5
"""Below this speed of both, nothing is decided, and noise would stand for driving."""
SAME_LEADER_M = 2.0
HARMLESS = {"speed_mps": 5.0, "gap_m": 20.0, "leader_speed_mps": 5.0, "next_speed_mps": 5.0}


@dataclass(frozen=True)
class Following:
    """Steps of ``D`` drivers, at most ``N`` each, in the order of time.

    Attributes:
        drivers: their names.
        step_s: length of every step.
        speed_mps, gap_m, leader_speed_mps: ``[D, N]`` before the step.
        next_speed_mps: ``[D, N]`` after it.
        used: ``[D, N]`` bool; places that are not used hold harmless numbers.
        continues: ``[D, N]`` bool: the step begins where the one before it ended, behind the same leader.
    """

    drivers: tuple[str, ...]
    step_s: float
    speed_mps: np.ndarray
    gap_m: np.ndarray
    leader_speed_mps: np.ndarray
    next_speed_mps: np.ndarray
    used: np.ndarray
    continues: np.ndarray

    def arrays(self) -> tuple[Any, ...]:
        """Return speed, gap, leader speed, next speed and used: what the model takes."""
        return self.speed_mps, self.gap_m, self.leader_speed_mps, self.next_speed_mps, self.used

    @property
    def minutes(self) -> float:
        """Time driven by all drivers together."""
        return float(self.used.sum()) * self.step_s / 60.0


@dataclass(frozen=True)
class ReadConfig:
    """How files become :class:`Following`.

    Attributes:
        step_s: keep every so many rows that steps are this long; ``None``: 0.5 s, the simulator's own, where the
            file's step divides it, and else the file's.
        default_length_m: of vehicles whose file says no length.
        heavy_from_m: vehicles of this length or more are heavy.
        max_drivers: of each class; more are drawn from by ``seed``.
        seed: of that draw.
    """

    step_s: float | None = None
    default_length_m: float | None = None
    heavy_from_m: float = 6.5
    max_drivers: int = 200
    seed: int = 0

    def __post_init__(self) -> None:
        if self.step_s is not None:
            check_range("--step-s", self.step_s, 0.05, 1.0, "s")
        if self.default_length_m is not None:
            check_range("--default-length-m", self.default_length_m, 0.5, 40.0, "m")
        check_range("--heavy-from-m", self.heavy_from_m, 1.0, 40.0, "m")
        check_range("--max-drivers", self.max_drivers, MIN_DRIVERS, 10_000)


def read_following(paths: Sequence[Path], config: ReadConfig) -> tuple[dict[str, Following], list[str]]:
    """Return the drivers of some files by class, ``light`` and ``heavy``, and what the user should know about it.

    Drivers of different files are different drivers. A class with fewer than five is left out.

    Raises:
        IzooError: a file cannot be used, the files differ in their step, or no class has enough drivers.
    """
    tables: list[pd.DataFrame] = []
    notes: list[str] = []
    steps: dict[float, Path] = {}
    for number, path in enumerate(paths):
        pairs, step_s, note = _steps_of(path, config)
        notes += [note] if note else []
        steps.setdefault(round(step_s, 4), path)
        if len(paths) > 1:
            pairs["driver"] = f"{number + 1}:" + pairs["driver"]
        tables.append(pairs)
    if len(steps) > 1:
        different = " and ".join(f"{path} {step:g} s" for step, path in steps.items())
        raise IzooError(f"the steps of the files differ: {different}; name one that divides into both with --step-s.")
    pairs = pd.concat(tables, ignore_index=True)
    found = {}
    for heavy, name in enumerate(CLASSES):
        of_class = pairs[pairs["heavy"] == bool(heavy)]
        data, said = _gather(of_class, step_s, name, config)
        notes += said
        if data is not None:
            found[name] = data
    if not found:
        steps_of = [pairs[pairs["heavy"] == bool(heavy)].groupby("driver").size() for heavy in range(len(CLASSES))]
        counts = " and ".join(
            f"{int((of_class >= MIN_STEPS).sum())} of {len(of_class)} {name} drivers"
            for name, of_class in zip(CLASSES, steps_of, strict=True)
            if len(of_class) or pairs.empty
        )
        raise IzooError(
            f"{', '.join(map(str, paths))}: {counts} have {MIN_STEPS} steps of {step_s:g} s behind a leader; a "
            f"population needs {MIN_DRIVERS} such drivers of a class. A step counts where the next row is {step_s:g} s "
            "later. Give more trajectories, at equal steps."
        )
    return found, notes


def _steps_of(path: Path, config: ReadConfig) -> tuple[pd.DataFrame, float, str | None]:
    """Return one file's steps, one row each, their length, and what the user should know."""
    pairs = read_pairs(path, config.default_length_m, config.heavy_from_m)
    pairs = pairs.sort_values(["driver", "time_s"], kind="stable").reset_index(drop=True)
    step_s = time_step(pairs, Problem(path))
    _check_classes(pairs, Problem(path))
    note = check_units(pairs, _consecutive(pairs, step_s), step_s, path)
    wanted = config.step_s or SIMULATOR_STEP_S
    every = round(wanted / step_s)
    fits = every >= 1 and abs(every * step_s - wanted) < 0.02 * step_s
    if config.step_s is not None and not fits:
        raise IzooError(f"--step-s is {wanted:g}, but the step of {path} is {step_s:g} s; give a multiple of it.")
    if fits and every > 1:
        first = pairs.groupby("driver")["time_s"].transform("min")
        pairs = pairs[((pairs["time_s"] - first) / step_s).round() % every == 0].reset_index(drop=True)
        step_s = wanted
    follows = _consecutive(pairs, step_s)
    pairs["next_speed_mps"] = pairs["speed_mps"].shift(-1)
    closing = pairs["leader_speed_mps"].shift(-1) - pairs["next_speed_mps"]
    foreseen = pairs["gap_m"] + closing * step_s
    same = follows & ((pairs["gap_m"].shift(-1) - foreseen).abs() < SAME_LEADER_M)
    pairs["continues"] = same.shift(1, fill_value=False)
    stand = (pairs["speed_mps"] < BOTH_STAND_MPS) & (pairs["leader_speed_mps"] < BOTH_STAND_MPS)
    pairs["continues"] &= ~stand.shift(1, fill_value=False)
    return pairs[follows & ~stand].reset_index(drop=True), step_s, note


def _consecutive(pairs: pd.DataFrame, step_s: float) -> pd.Series:
    """Whether the next row is the same driver's next step."""
    apart = pairs["time_s"].shift(-1) - pairs["time_s"]
    return (pairs["driver"] == pairs["driver"].shift(-1)) & ((apart - step_s).abs() < 0.5 * step_s)


def _check_classes(pairs: pd.DataFrame, problem: Problem) -> None:
    """A driver keeps the vehicle, and so its class."""
    changed = pairs["heavy"] != pairs.groupby("driver")["heavy"].transform("first")
    remedy = "the driver is light in some rows and heavy in others; tell two drivers apart, or give one length"
    problem.refuse(pairs, changed, "driver", remedy)


def _gather(pairs: pd.DataFrame, step_s: float, name: str, config: ReadConfig) -> tuple[Following | None, list[str]]:
    """Return one class's drivers as padded arrays, and notes on who was left out."""
    counts = pairs.groupby("driver", sort=True).size()
    enough = counts[counts >= MIN_STEPS].index.to_numpy()
    notes = []
    if len(enough) < len(counts):
        notes.append(f"{len(counts) - len(enough)} {name} drivers have fewer than {MIN_STEPS} steps and are left out")
    if len(enough) < MIN_DRIVERS:
        return None, notes
    if len(enough) > config.max_drivers:
        notes.append(
            f"{config.max_drivers} of {len(enough)} {name} drivers are used, drawn by the seed (--max-drivers)"
        )
        enough = np.sort(np.random.default_rng(config.seed).choice(enough, config.max_drivers, replace=False))
    places = min(int(counts[enough].max()), MAX_STEPS)
    if counts[enough].max() > MAX_STEPS:
        notes.append(f"of a {name} driver, the first {MAX_STEPS} steps are used")
    groups = dict(list(pairs.groupby("driver")))
    columns = {key: np.full((len(enough), places), value) for key, value in HARMLESS.items()}
    used, continues = (np.zeros((len(enough), places), bool) for _ in range(2))
    for row, driver in enumerate(enough):
        own = groups[driver].iloc[:places]
        for key, column in columns.items():
            column[row, : len(own)] = own[key]
        used[row, : len(own)] = True
        continues[row, : len(own)] = own["continues"]
    continues[:, 0] = False
    return Following(tuple(enough), step_s, **columns, used=used, continues=continues), notes
