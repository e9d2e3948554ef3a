"""Tables of episodes with chosen numbers."""

from collections.abc import Sequence
from typing import Any

import pandas as pd

from izoo.envs.mdp.metric_sums import APPROACH_METRICS


def episode_row(
    co2_g: float = 100.0,
    delay_s: float = 20.0,
    *,
    policy: str = "ppo",
    context: str = "x/1/A",
    approach: str = "A",
    seed: int = 0,
    train_seed: int = 0,
    simulator: str = "sumo",
    demand: str = "one",
    volume_over_capacity: float = 0.5,
    engine: str = "combustion",
    cohort: float = 10.0,
    **sums: float,
) -> dict[str, object]:
    """One row: an approach in an episode, whose cohort burns ``co2_g`` and loses ``delay_s`` a vehicle.

    A fifth of both is spent blocked. Everybody crosses; sums that are not given follow from that, or are 0.
    """
    values = dict.fromkeys(APPROACH_METRICS, 0.0)
    values.update(cohort=cohort, cohort_left=cohort, entered=cohort, crossed=cohort, crossed_hdv=cohort)
    values.update(cohort_region_co2_g=0.8 * co2_g * cohort, cohort_blocked_co2_g=0.2 * co2_g * cohort)
    values.update(cohort_region_delay_s=0.8 * delay_s * cohort, cohort_blocked_s=0.2 * delay_s * cohort)
    values.update(emission_g=0.7 * co2_g * cohort, vehicle_steps=100.0 * cohort, travel_time_s=50.0 * cohort)
    values.update(distance_m=400.0 * cohort, **sums)
    return {
        "task": "test",
        "policy": policy,
        "train_seed": train_seed,
        "simulator": simulator,
        "context": context,
        "context_hash": f"hash-{context}",
        "intersection": context.rsplit("/", 1)[0],
        "city": None,
        "approach": approach,
        "seed": seed,
        "demand": demand,
        "engine": engine,
        "adoption": 1 / 3,
        "volume_over_capacity": volume_over_capacity,
        **values,
    }


def compared(
    savings: dict[str, Sequence[float]],
    delays: dict[str, float] | None = None,
    train_seeds: dict[str, int] | None = None,
    **settings: object,
) -> pd.DataFrame:
    """Policies on as many intersections as there are savings (per cent over uncommanded), baselines beside them."""
    rows = []
    places = max(len(values) for values in savings.values())
    seeds = train_seeds or {}
    for k in range(places):
        for policy, co2_g in (("human", 120.0 + k), ("uncommanded", 100.0 + k)):
            rows.append(episode_row(co2_g, policy=policy, context=f"x/{k}/A", **settings))  # type: ignore[arg-type]
        for policy, values in savings.items():
            delay_s = 20.0 + (delays or {}).get(policy, 0.0) * (1.0 + 0.01 * k)
            for train_seed in range(seeds.get(policy, 1)) if k < len(values) else ():
                of: Any = {"policy": policy, "context": f"x/{k}/A", "train_seed": train_seed, **settings}
                rows.append(episode_row((100.0 + k) * (1.0 - values[k] / 100.0), delay_s, **of))
    return pd.DataFrame(rows)
