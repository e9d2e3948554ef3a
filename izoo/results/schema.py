"""The columns of the table, declared once. A row is one approach of one episode of one policy."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pandas as pd

from izoo.contexts.context import Context
from izoo.envs.mdp.metric_sums import APPROACH_METRICS, EPISODE_METRICS
from izoo.networks.road import RoadNet
from izoo.networks.signals.delay import SATURATION_VPH
from izoo.networks.turning import exit_shares
from izoo.results.rows_file import Row

IDENTITY = (
    "task",
    "policy",
    "train_seed",
    "simulator",
    "context",
    "context_hash",
    "context_id",
    "intersection",
    "city",
    "approach",
    "seed",
    "demand",
    "hour",
    "season",
    "engine",
    "adoption",
    "cv_vehicle",
    "temperature_c",
    "humidity_pct",
)
"""Which episode a row belongs to. ``train_seed`` is 0 where nothing was trained; ``demand`` is ``one`` (approach) or
``all``; the context is the one that is evaluated, also in rows of human driving, so that rows pair up."""
OF_CONTEXT = ("context_id", "hour", "season", "engine", "adoption", "cv_vehicle", "temperature_c", "humidity_pct")
FEATURES = {
    "flow_vph_per_lane": "inflow (veh/h per lane)",
    "lane_count": "lanes",
    "lane_length_m": "approach length (m)",
    "speed_limit_mps": "speed limit (m/s)",
    "grade": "road grade (rise over run)",
    "green_share": "green share of the cycle",
    "cycle_s": "cycle (s)",
    "volume_over_capacity": "volume over capacity",
}
"""What the approach is like, and what it is called; ``green_share`` is the mean over its movements."""
EPISODE_COLUMNS = tuple(f"episode_{name}" for name in EPISODE_METRICS)
COLUMNS = (*IDENTITY, *FEATURES, *APPROACH_METRICS, *EPISODE_COLUMNS)
EPISODE = ("policy", "train_seed", "simulator", "context_hash", "seed")
KEY = (*EPISODE, "approach")
"""No two rows agree on these."""
WHOLE = ("train_seed", "context_id", "seed")
TEXT = tuple(name for name in IDENTITY if name not in {*WHOLE, "adoption", "temperature_c", "humidity_pct"})


def identity(
    policy: str, train_seed: int, simulator: str, context: Context, seed: int, approach: str, task: str = ""
) -> Row:
    """Return the columns :data:`IDENTITY` of a row."""
    return {name: getattr(context, name) for name in OF_CONTEXT} | {
        "task": task,
        "policy": policy,
        "train_seed": train_seed,
        "simulator": simulator,
        "context": context.name,
        "context_hash": context.content_hash,
        "intersection": context.intersection.name,
        "city": context.intersection.city,
        "approach": approach,
        "seed": seed,
        "demand": "all" if context.approach is None else "one",
    }


def scored_approaches(context: Context) -> tuple[str, ...]:
    """Approaches that get a row: the one with demand, or all."""
    return context.intersection.approach_names if context.approach is None else (context.approach,)


def features(context: Context, road: RoadNet, approach: str) -> dict[str, float]:
    """Return the columns :data:`FEATURES` of a row."""
    p = road.approaches.index(approach)
    served = road.movement_turn[p] >= 0
    green = float(road.clock.green_s[p][served].mean()) if served.any() else 0.0
    return {
        "flow_vph_per_lane": context.flow_vph_per_lane(approach),
        "lane_count": float(road.lane_count[p]),
        "lane_length_m": float(road.lane_length_m[p]),
        "speed_limit_mps": float(road.speed_limit_mps[p]),
        "grade": float(road.grade[p]),
        "green_share": green / float(road.clock.cycle_s),
        "cycle_s": float(road.clock.cycle_s),
        "volume_over_capacity": volume_over_capacity(context, road, p),
    }


def volume_over_capacity(context: Context, road: RoadNet, approach: int) -> float:
    """Return demand over capacity of one approach; above 1 its queue grows without end.

    The larger of the busiest movement's ratio, over the lanes that lead to it, and the ratio of the approach as a
    whole, whose lanes must find room for all movements in their greens. Permissive greens count in full and
    movements that may turn on red count as free, so the true ratio is not below this one. 0 without demand.
    """
    name = road.approaches[approach]
    volume = context.flow_vph_per_lane(name) * float(road.main_lane_count[approach])
    if volume == 0.0:
        return 0.0
    links = road.movement_links[approach]
    shares = exit_shares(context.intersection.leg(name).approach, road.exits, road.movement_turn[approach], links)
    green_share = road.clock.green_s[approach] / road.clock.cycle_s
    free_on_red = road.clock.legal_on_red[approach].any(axis=-1)
    lanes_needed, busiest = 0.0, 0.0
    for exit_leg in np.flatnonzero(shares > 0):
        if green_share[exit_leg] <= 0.0:
            if free_on_red[exit_leg]:
                continue
            return math.inf
        lanes = volume * shares[exit_leg] / (SATURATION_VPH * green_share[exit_leg])
        lanes_needed += lanes
        busiest = max(busiest, lanes / max(float(links[exit_leg]), 1.0))
    return float(max(busiest, lanes_needed / float(road.lane_count[approach])))


def make_table(rows: Iterable[Row]) -> pd.DataFrame:
    """Return rows as a table with all columns in order, sorted by policy, training seed, context, seed and approach."""
    table = pd.DataFrame(list(rows), columns=list(COLUMNS))
    for column in TEXT:
        table[column] = table[column].astype(object).where(table[column].notna(), None)
    table["task"] = table["task"].fillna("")
    for column in WHOLE:
        table[column] = table[column].astype("Int64")
    numbers = [column for column in COLUMNS if column not in TEXT and column not in WHOLE]
    table[numbers] = table[numbers].astype(float)
    order = ["policy", "train_seed", "simulator", "context", "context_hash", "seed", "approach"]
    return table.sort_values(order, kind="stable", ignore_index=True)
