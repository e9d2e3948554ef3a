"""What the episodes that end within a batch achieved."""

from __future__ import annotations

from tensordict import TensorDictBase

from izoo.algos.learners.base import MASK, REWARD
from izoo.envs.mdp.frame import TOTALS
from izoo.metrics.figures import level_tensors
from izoo.training.environments import NUMBERS, split_totals

LOGGED = (
    "emission_g_per_vehicle",
    "throughput",
    "travel_time_s_per_vehicle",
    "approach_speed_mps",
    "stopped_time_s_per_vehicle",
    "unfinished_share",
    "deferred_share",
)
"""Figures that training logs; shares as fractions."""

READS = (MASK, ("next", *REWARD), ("next", "done"), ("next", TOTALS), ("next", NUMBERS))
"""What :func:`episode_stats` reads of a batch."""


def episode_stats(batch: TensorDictBase, partial: int = 0) -> dict[str, float]:
    """Summarise a batch: the reward of all valid agent-steps, and the figures of the episodes that ended in it.

    Args:
        batch: ``[N, T]`` steps of a training environment.
        partial: episodes with numbers below this were not commanded from their beginning on; they are left out.

    Episodes that were lost with their worker report no steps, and are left out.

    Returns:
        ``reward``, ``agents`` (mean number of CVs per step), ``episodes``, and, if any ended, ``return``,
        ``collisions``, and :data:`LOGGED` pooled over them (every vehicle weighs the same). What is unknown is
        left out.
    """
    mask, reward = batch.get(MASK), batch.get(("next", *REWARD)).squeeze(-1)
    stats = {"agents": float(mask.sum(-1).float().mean())}
    if mask.any():
        stats["reward"] = float(reward[mask].mean())
    ended = batch.get(("next", "done")).squeeze(-1)
    totals = batch.get(("next", TOTALS))[ended]
    whole = split_totals(totals)[0]["steps"] > 0
    stats["episodes"] = float(whole.sum())
    if partial > 0:
        whole &= batch.get(("next", NUMBERS))[ended][:, 0] >= partial
    totals = totals[whole]
    count = len(totals)
    if count == 0:
        return stats
    episode, approach = split_totals(totals)
    stats["return"] = float(episode["return"].mean())
    stats["collisions"] = float(episode["collisions"].mean())
    sums = {name: value.double().sum() for name, value in approach.items()}
    for name, (value, valid) in level_tensors(sums, LOGGED).items():
        if bool(valid) and name == "throughput":
            stats["throughput_veh_per_episode"] = float(value) / count
        elif bool(valid):
            stats[name] = float(value)
    return stats
