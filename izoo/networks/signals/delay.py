"""Control delay at a fixed-time signal after the Highway Capacity Manual (uniform and overflow part), by array.

``M`` counts movements (from leg, to leg), ``K`` the intervals of a plan, ``N`` timings that are compared at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from izoo.contexts.context import FLOW_CAP_VPH_PER_LANE, HOUR_FACTOR
from izoo.contexts.movements import conflict
from izoo.contexts.spec import IntersectionSpec
from izoo.networks.net.connections import Link, signal_links
from izoo.networks.turning import LEFT, RIGHT, STRAIGHT, exit_shares

SATURATION_VPH = 1800.0
"""Saturation flow of a lane."""
TURN_FACTOR = {"r": 0.85, "s": 1.0, "l": 0.95}
ANALYSIS_H = 0.25
"""Analysis period of the overflow part."""
CRITICAL_GAP_S, FOLLOW_UP_S, SNEAKERS = 4.5, 2.5, 2.0
"""Permissive turns: critical gap, follow-up time, and how many go per cycle at the end of green."""
TURNS = {"r": RIGHT, "s": STRAIGHT, "l": LEFT}
States = Sequence[Sequence[tuple[str, str, str]]]
"""Per interval, ``(from_leg, to_leg, colour)`` of the movements that are not red."""


@dataclass(frozen=True)
class Movement:
    """One movement: its bearings (from, to), its demand in veh/h and the lanes that serve it."""

    start: str
    end: str
    way: tuple[float, float]
    turn: str
    flow_vph: float
    lanes: tuple[int, ...]


def peak_movements(spec: IntersectionSpec) -> tuple[Movement, ...]:
    """Return the movements that lanes allow, with their peak-hour demand."""
    movements: list[Movement] = []
    links = signal_links(spec)
    for leg in spec.legs:
        if leg.approach is None:
            continue
        per_lane = min(leg.approach.aadt_per_lane * HOUR_FACTOR["peak"], FLOW_CAP_VPH_PER_LANE)
        by_exit: dict[str, list[Link]] = {}
        for link in links:
            if link.from_leg == leg.name:
                by_exit.setdefault(link.to_leg, []).append(link)
        turns = np.array([TURNS[served[0].turn] for served in by_exit.values()])
        served_by = np.array([len(served) for served in by_exit.values()])
        shares = exit_shares(leg.approach, tuple(by_exit), turns, served_by)
        for share, (end, served) in zip(shares.tolist(), by_exit.items(), strict=True):
            flow_vph = per_lane * leg.approach.main_lane_count * share
            lanes = tuple(link.from_lane for link in served)
            way = leg.bearing_deg, spec.leg(end).bearing_deg
            movements.append(Movement(leg.name, end, way, served[0].turn, flow_vph, lanes))
    return tuple(movements)


class DelayModel:
    """Delay of an intersection's movements under plans that show the same intervals for different times.

    Args:
        spec: the intersection.
        states: what each interval shows.
    """

    def __init__(self, spec: IntersectionSpec, states: States) -> None:
        self.movements = peak_movements(spec)
        position = {(movement.start, movement.end): m for m, movement in enumerate(self.movements)}
        shape = (len(self.movements), len(states))
        self.protected, self.permissive = np.zeros(shape), np.zeros(shape)
        for k, shown in enumerate(states):
            for start, end, colour in shown:
                if (start, end) in position and colour in "Gg":
                    table = self.protected if colour == "G" else self.permissive
                    table[position[start, end], k] = 1.0
        self.opposing_vph, self.opposing_lanes = np.zeros(shape[0]), np.ones(shape[0])
        for m in range(shape[0]):
            self._find_opposing(m)
        self.groups = _lane_groups(self.movements)

    def _find_opposing(self, m: int) -> None:
        """Sum the traffic that a permissive movement yields to: protected, conflicting, green at the same time."""
        foes = [
            other
            for other in range(len(self.movements))
            if (self.permissive[m] * self.protected[other]).any()
            and conflict(self.movements[m].way, self.movements[other].way)
        ]
        self.opposing_vph[m] = sum(self.movements[other].flow_vph for other in foes)
        lanes = {(self.movements[other].start, lane) for other in foes for lane in self.movements[other].lanes}
        self.opposing_lanes[m] = max(len(lanes), 1)

    def total(self, durations_s: np.ndarray, cycle_s: np.ndarray, starts: Sequence[str] | None = None) -> np.ndarray:
        """Return the total delay in vehicle-seconds per hour, ``[N]``.

        Args:
            durations_s: ``[N, K]`` of the intervals.
            cycle_s: ``[N]``; given separately because the intervals may be those of a part of the cycle.
            starts: legs whose traffic counts; ``None`` for all.
        """
        capacity, green_s = self._capacity(durations_s @ self.protected.T, durations_s @ self.permissive.T, cycle_s)
        total = np.zeros(len(cycle_s))
        for members, lane_count in self.groups:
            flows = np.array([self.movements[m].flow_vph for m in members])
            if flows.sum() <= 0.0 or (starts is not None and self.movements[members[0]].start not in starts):
                continue
            weights = flows / flows.sum()
            # Lanes shared by several movements serve them in the order of arrival.
            group_vph = lane_count / (weights / capacity[:, members]).sum(axis=1)
            share = (weights * green_s[:, members]).sum(axis=1) / cycle_s
            total += flows.sum() * _delay_s(flows.sum() / group_vph, group_vph, share, cycle_s)
        return total

    def _capacity(
        self, protected_s: np.ndarray, permissive_s: np.ndarray, cycle_s: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return per timing and movement the capacity of one lane in veh/h and the usable green in s, ``[N, M]``."""
        cycle = cycle_s[:, None]
        saturation = SATURATION_VPH * np.array([TURN_FACTOR[movement.turn] for movement in self.movements])
        opposing = self.opposing_vph
        # The queue that built up during red has to clear before gaps appear.
        discharge = np.maximum(self.opposing_lanes * SATURATION_VPH - opposing, 1.0)
        free_s = np.clip(permissive_s - opposing * (cycle - permissive_s) / discharge, 0.0, None)
        rate = np.maximum(opposing, 1.0)
        gaps_vph = rate * np.exp(-rate * CRITICAL_GAP_S / 3600.0) / -np.expm1(-rate * FOLLOW_UP_S / 3600.0)
        sneakers = SNEAKERS / np.array([len(movement.lanes) for movement in self.movements])
        sneakers_vph = 3600.0 / cycle * np.where(permissive_s > 0.0, sneakers, 0.0)
        permitted = np.minimum(np.minimum(gaps_vph, saturation) * free_s / cycle + sneakers_vph, saturation)
        # A movement that is never green still gets one vehicle per cycle, so that delays stay finite.
        capacity = np.maximum(saturation * protected_s / cycle + permitted, 3600.0 / cycle)
        return capacity, protected_s + free_s


def _lane_groups(movements: Sequence[Movement]) -> list[tuple[list[int], int]]:
    """Return sets of movements that share lanes, each with its number of lanes."""
    groups: list[tuple[list[int], set[tuple[str, int]]]] = []
    for m, movement in enumerate(movements):
        members, lanes = [m], {(movement.start, lane) for lane in movement.lanes}
        for other in [group for group in groups if group[1] & lanes]:
            groups.remove(other)
            members, lanes = other[0] + members, other[1] | lanes
        groups.append((members, lanes))
    return [(members, len(lanes)) for members, lanes in groups]


def _delay_s(degree: np.ndarray, capacity_vph: np.ndarray, green_share: np.ndarray, cycle_s: np.ndarray) -> np.ndarray:
    """HCM 2000, equations 16-11 and 16-12, with k = 0.5 and I = 1: delay per vehicle in s."""
    uniform = 0.5 * cycle_s * (1.0 - green_share) ** 2 / (1.0 - np.minimum(degree, 1.0) * np.minimum(green_share, 0.99))
    excess = degree - 1.0
    root = np.sqrt(excess**2 + 4.0 * degree / (capacity_vph * ANALYSIS_H))
    return uniform + 900.0 * ANALYSIS_H * (excess + root)
