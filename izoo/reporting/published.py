"""Figures of the IntersectionZoo paper (ICLR 2025, arXiv 2410.15221), at adoption 1/3; ratio of sums after gating."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """One published result.

    Attributes:
        protocol, algorithm: what was trained and tested.
        benefit: emission benefit, ratio of sums.
        throughput_benefit: relative change of throughput.
        throughput_kept: share of approaches whose throughput did not fall.
    """

    protocol: str
    algorithm: str
    benefit: float
    throughput_benefit: float
    throughput_kept: float


PUBLISHED = (
    Published("Salt Lake City", "DDPG", -0.0185, 0.0648, 0.802),
    Published("Salt Lake City", "PPO", -0.0959, 0.0154, 0.129),
    Published("Atlanta", "DDPG", -0.0129, 0.0445, 0.629),
    Published("Atlanta", "PPO", -0.1486, 0.0269, 0.266),
)
