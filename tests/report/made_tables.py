"""Tables of results with chosen numbers, and folders of them."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from izoo.envs.config import EnvConfig
from izoo.envs.mdp.metric_sums import APPROACH_METRICS
from izoo.results.schema import COLUMNS, EPISODE_COLUMNS, FEATURES
from izoo.results.store import PolicyRecord, Store
from tests.metrics.tables import episode_row

BURNED_G, DELAY_S, COHORT = 200.0, 20.0, 40
PPO = (0.06, -1.0, 4)
SEVERAL = {"ppo": PPO, "glide": (0.03, 0.0, 1), "cap_0.6": (0.08, 5.0, 1)}
"""Policies for :func:`table`."""


def row(policy: str, place: int, saved: float, slower_s: float, train_seed: int, seed: int) -> dict[str, object]:
    """A row of an intersection in which a policy saves a share of the CO2, and adds a delay."""
    wobble = 0.01 * np.sin(7.0 * place + train_seed)
    grams = BURNED_G * (1.0 + 0.1 * place) * (1.0 - saved * (1.0 + wobble) - (wobble if saved else 0.0))
    sums = {"cohort": float(COHORT), "cohort_left": COHORT - 1.0, "crossed": COHORT - 2.0, "due": COHORT + 4.0}
    sums |= {"cohort_region_co2_g": COHORT * grams, "cohort_blocked_co2_g": 0.0, "cohort_blocked_s": 0.0}
    sums |= {"cohort_region_delay_s": COHORT * (DELAY_S + slower_s * (1.0 + wobble)), "nan_actions": 0.0}
    sums |= {"entered": float(COHORT), "unfinished": 2.0, "vehicle_steps": 100.0 * COHORT, "agent_steps": 30.0 * COHORT}
    sums |= {"emission_g": (COHORT - 2.0) * 0.4 * grams, "region_emission_g": COHORT * grams}
    of = {"policy": policy, "context": f"town/{place}/A", "train_seed": train_seed, "seed": seed}
    made = episode_row(**of, volume_over_capacity=0.5 if place % 4 else 1.5)  # type: ignore[arg-type]
    made |= {"task": "town test", "city": "town", "context_id": place, "season": "winter"}
    made["context_hash"] = hashlib.sha256(str(place).encode()).hexdigest()
    made |= dict.fromkeys(FEATURES.keys() - made.keys(), 1.0) | {"lane_length_m": 200.0 + 20.0 * place}
    known = dict.fromkeys(COLUMNS) | dict.fromkeys(EPISODE_COLUMNS, 0.0)
    return known | made | dict.fromkeys(APPROACH_METRICS, 1.0) | sums


def table(policies: Mapping[str, tuple[float, float, int]], places: int = 12, seeds: int = 1) -> pd.DataFrame:
    """Rows of policies, human driving and uncommanded.

    Args:
        policies: by name: share of CO2 saved over uncommanded, delay added in s, training seeds.
    """
    every = {"human": (-0.1, 1.0, 1), "uncommanded": (0.0, 0.0, 1), **policies}
    rows = [
        row(name, place, saved, slower_s, train_seed, seed)
        for name, (saved, slower_s, train_seeds) in every.items()
        for train_seed in range(train_seeds)
        for place in range(places)
        for seed in range(1, seeds + 1)
    ]
    return pd.DataFrame(rows)[list(COLUMNS)]


def folder(path: Path, made: pd.DataFrame, task: str = "town test", complete: bool = True) -> Path:
    """A folder of results with these rows."""
    keys = made[["policy", "train_seed"]].drop_duplicates().itertuples(index=False, name=None)
    records = {key: PolicyRecord("trained" if key[0] == "ppo" else "scripted") for key in keys}
    store = Store(path, task=task, config=EnvConfig())
    try:
        with store.open(records):
            store.add(made.to_dict("records"))
            if not complete:
                raise KeyboardInterrupt
    except KeyboardInterrupt:
        pass
    return path
