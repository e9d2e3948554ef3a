"""Figures of the IntersectionZoo paper (ICLR 2025, arXiv 2410.15221), at adoption 1/3; ratio of sums after gating."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """One published result.

    Attributes:
        protocol, algorithm: what was trained and tested.
        at_zero: approaches in the histogram's bar at 0.
        approaches: all approaches of the histogram.
        benefit: emission benefit, ratio of sums; ``None`` where none was published.
        throughput_benefit: relative change of throughput.
        throughput_kept: share of approaches whose throughput did not fall.
    """

    protocol: str
    algorithm: str
    at_zero: int
    approaches: int
    benefit: float | None = None
    throughput_benefit: float | None = None
    throughput_kept: float | None = None


PUBLISHED = (
    Published("Salt Lake City", "DDPG", 248, 1048, -0.0185, 0.0648, 0.802),
    Published("Salt Lake City", "PPO", 913, 1048, -0.0959, 0.0154, 0.129),
    Published("Atlanta", "DDPG", 858, 2152, -0.0129, 0.0445, 0.629),
    Published("Atlanta", "PPO", 1581, 2152, -0.1486, 0.0269, 0.266),
    Published("Salt Lake City -> Atlanta", "DDPG", 945, 2152),
    Published("Salt Lake City -> Atlanta", "PPO", 1791, 2152),
    Published("Systematicity", "DDPG", 40, 128),
    Published("Systematicity", "PPO", 119, 128),
)
