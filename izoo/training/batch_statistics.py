"""What the episodes that end within a batch achieved."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import TensorDictBase

from izoo.algos.learners.base import EPISODES, MASK, REWARD
from izoo.envs.mdp.frame import TOTALS
from izoo.metrics.figures import level_tensors
from izoo.training.environments import split_totals

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

READS = (MASK, ("next", *REWARD), ("next", "done"), ("next", TOTALS), ("next", EPISODES))
"""What :func:`episode_stats` reads of a batch."""


def episode_stats(batch: TensorDictBase, partial: int = 0) -> dict[str, float]:
    """Summarise a batch: the reward of all valid agent-steps, and the figures of the episodes that ended in it.

    Args:
        batch: ``[N, T]`` steps of a training environment.
        partial: episodes with numbers below this were not commanded from their beginning on; they are left out.

    Episodes that were lost with their worker report no steps, and are left out.

    Returns:
        ``reward``, ``agents`` and ``most_agents`` (mean and largest number of CVs in a step), ``episodes``, and, if any
        ended, ``return``, ``collisions``, and :data:`LOGGED` pooled over them (every vehicle weighs the same). What is
        unknown is left out.
    """
    mask, reward = batch.get(MASK), batch.get(("next", *REWARD)).squeeze(-1)
    agents = mask.sum(-1).float()
    stats = {"agents": float(agents.mean()), "most_agents": float(agents.max())}
    if mask.any():
        stats["reward"] = float(reward[mask].mean())
    ended = batch.get(("next", "done")).squeeze(-1)
    totals = batch.get(("next", TOTALS))[ended]
    whole = split_totals(totals)[0]["steps"] > 0
    stats["episodes"] = float(whole.sum())
    if partial > 0:
        whole &= batch.get(("next", EPISODES))[ended][:, 0] >= partial
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


def unused_slots(in_use: Sequence[float], slots: int) -> str:
    """Say how many agent slots were in use at once, and what would do, where most of them never were; else nothing."""
    most = int(max(in_use, default=0))
    enough = max(4, 2 ** (2 * most - 1).bit_length())
    if not 0 < most <= enough <= slots // 2:
        return ""
    return f"At most {most} of {slots} agent slots were in use at once; env.num_agents={enough} saves memory."
