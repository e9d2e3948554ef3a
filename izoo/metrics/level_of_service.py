"""Control delay, level of service and queues by movement, as traffic engineers report them.

Levels are those of motor vehicles at signalised intersections in the Highway Capacity Manual, 6th edition (TRB, 2016),
exhibit 19-8, by control delay alone; the manual also gives F to a lane group whose volume exceeds its capacity.

The delay here is time that the cohort lost in the region (approach, junction and exit) against driving at the limit.
Time for which vehicles were blocked outside, by a queue
that reaches so far or by signals upstream, stands apart.
"""

from __future__ import annotations

import math

import pandas as pd

MOST_DELAY_S = {"A": 10.0, "B": 20.0, "C": 35.0, "D": 55.0, "E": 80.0, "F": math.inf}
"""Levels, and up to which control delay each goes, s per vehicle."""
_DELAYS = {"delay_s": "region_delay_s", "blocked_s": "blocked_s"}
MOVEMENTS = ("right", "straight", "left")
_SUMS = ("cohort", "cohort_region_delay_s", "cohort_blocked_s", "queue", "queue_max")
PLACE = ["intersection", "approach", "movement"]


def level_of_service(delay_s: float) -> str:
    """Return the level of a control delay; empty for NaN."""
    return next((level for level, most_s in MOST_DELAY_S.items() if delay_s <= most_s), "")


def by_movement(table: pd.DataFrame, policy: str) -> pd.DataFrame:
    """Return what the vehicles of each movement met under a policy, means over episodes and training seeds.

    Args:
        table: rows of one simulator.

    Returns:
        One row per intersection, approach and movement that had vehicles, indexed by :data:`PLACE`: ``vehicles`` (of
        the cohort, per episode), ``delay_s`` and ``blocked_s`` (per vehicle), ``level``, ``queue_max`` (the most
        vehicles that stood before the line at once) and ``queue`` (those that stood there at the horizon), mean over
        episodes, and ``volume_over_capacity`` of the approach. Empty where the rows have no sums by movement.
    """
    rows, parts = table[table["policy"] == policy], []
    for movement in MOVEMENTS:
        names = {f"{movement}_{name}": name for name in _SUMS}
        part = rows[["intersection", "approach", "volume_over_capacity", *names]].dropna(subset=list(names))
        parts.append(part.rename(columns=names).assign(movement=movement))
    means = pd.concat(parts).groupby(PLACE, sort=False).mean().sort_index(level=[0, 1], sort_remaining=False)
    means = means[means["cohort"] > 0.0]
    vehicles = means.pop("cohort")
    delays = {name: means.pop(f"cohort_{column}") / vehicles for name, column in _DELAYS.items()}
    return means.assign(vehicles=vehicles, **delays, level=[level_of_service(delay) for delay in delays["delay_s"]])


def by_intersection(movements: pd.DataFrame) -> pd.DataFrame:
    """Return ``vehicles``, ``delay_s``, ``blocked_s`` and ``level`` of intersections; every vehicle weighs the same.

    Args:
        movements: of :func:`by_movement`.
    """
    vehicles = movements["vehicles"]
    each = movements[["delay_s", "blocked_s"]].mul(vehicles, axis=0).assign(vehicles=vehicles)
    added = each.groupby(level="intersection", sort=False).sum()
    added[["delay_s", "blocked_s"]] = added[["delay_s", "blocked_s"]].div(added["vehicles"], axis=0)
    return added.assign(level=[level_of_service(delay) for delay in added["delay_s"]])
