"""Fixed-time plans that give each approach a required number of phases and a required share of green.

The published statistics of a city say, per approach, how many phases serve it (``phase_count``: distinct sets of its
movements that are green together) and for which share of the cycle any of its movements is green
(``signal_time_ratio``). :func:`build_plan` turns these requirements into a plan. Opposite approaches form an axis; axes
take turns. Where the axes ask for more than the cycle holds, an approach that has a phase to spare gets the rest as a
right-turn overlap while another axis is served, as in the measured plans; without one its share is cut.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from izoo.contexts.movements import conflict, deflection_deg
from izoo.contexts.spec import SignalPhase, SignalPlan

TICK_S = 0.5
"""All times are multiples of the simulation step; the code below counts in ticks."""
MIN_CYCLE_S, MAX_CYCLE_S = 46.0, 111.0
"""Range of the measured cycles."""
MIN_GREEN_S = 8.0
FAST_MPS = 17.0
LEFT_SHARE = 0.35
"""Share of an approach's green that its own left phase gets (measured: 15 s of about 40 s)."""
PERMISSIVE_LEFT_SHARE = 0.6
"""The same where lefts have no protected phase and go while the opposite approach may be green as well."""
OVERLAP_SHARE = 0.15
"""Share of an approach's green that a right-turn overlap gets when only the phase count asks for one."""
MIN_CORE_SHARE = 0.4
"""Share of its green that an approach keeps in its own axis when the rest becomes an overlap."""
SNAP_S = 1.5
"""Opposite approaches whose greens differ by no more than this get the same green (nine of ten measured pairs do)."""
_PRIORITY = {"s": 0, "r": 1, "l": 2}
_Interval = tuple[int, int]


@dataclass(frozen=True)
class Need:
    """What the plan must give one approach.

    Attributes:
        bearing_deg: of its leg.
        exits: per turn that its lanes allow (``r``, ``s``, ``l``), name and bearing of each leg that it leads to.
        phase_count, green_share: the requirements.
        own_left: whether lefts can have a phase of their own (they have a lane, or nothing else is served with them).
    """

    bearing_deg: float
    exits: Mapping[str, tuple[tuple[str, float], ...]]
    phase_count: int
    green_share: float
    own_left: bool

    @property
    def has_left_phase(self) -> bool:
        """Whether one of its phases is there for lefts."""
        return self.phase_count >= 2 and self.own_left and "l" in self.exits and len(self.exits) > 1

    @property
    def has_overlap(self) -> bool:
        """Whether the phase count asks for a right-turn overlap."""
        return self.phase_count - 1 - self.has_left_phase > 0 and self.may_overlap

    @property
    def may_overlap(self) -> bool:
        """Whether a right-turn overlap can be one of its phases."""
        return self.phase_count >= 2 and "r" in self.exits and len(self.exits) > 1


@dataclass
class _Served:
    """Times of one approach: ticks of green within its axis, ticks of overlap just before, and its left phase."""

    need: Need
    core: int = 0
    overlap: int = 0
    left_phase: bool = False


@dataclass
class _Axis:
    """Approaches that are served together; ``shared_left`` gives the lefts of both a common, protected phase."""

    members: list[_Served]
    shared_left: bool

    @property
    def common_left(self) -> int:
        """Ticks of the common left phase."""
        return min(round(LEFT_SHARE * member.core) for member in self.members) if self.shared_left else 0

    def window(self, yellow: int) -> int:
        """Return the least ticks that the axis takes, without its last yellow."""
        return max(member.core for member in self.members) + (yellow if self.shared_left else 0)

    def stretched(self, yellow: int) -> int:
        """Return the ticks it takes when its approaches are served one after the other as far as possible."""
        return sum(member.core for member in self.members) - self.common_left + (yellow if self.shared_left else 0)

    def intervals(self, start: int, width: int, yellow: int) -> Iterator[tuple[int, str, _Interval]]:
        """Yield ``(member, turn, green interval)`` when the axis is served from ``start`` for ``width`` ticks."""
        end, left = start + width, self.common_left
        for position, member in enumerate(self.members):
            if self.shared_left:
                through = member.core - left
                first = start if position == 0 else end - left - yellow - through
                yield position, "l", (end - left, end)
                core = (first, first + through)
            else:
                core = (start, start + member.core) if position == 0 else (end - member.core, end)
                part = round(PERMISSIVE_LEFT_SHARE * member.core) if member.left_phase else member.core
                yield position, "l", (core[0], core[0] + part) if position == 0 else (core[1] - part, core[1])
            yield position, "s", core
            yield position, "r", (core[0] - member.overlap, core[1])


def yellow_time_s(speed_limits_mps: Sequence[float]) -> float:
    """Return the yellow time: 3 s, or 4 s where a limit exceeds 17 m/s."""
    return 4.0 if max(speed_limits_mps) > FAST_MPS else 3.0


def build_plan(axes: Sequence[Sequence[str]], needs: Mapping[str, Need], yellow_s: float) -> SignalPlan:
    """Build the plan.

    Args:
        axes: names of the legs that are served together, one or two per axis, in the order of service.
        needs: per leg name, what it needs.
        yellow_s: yellow time.

    Right turns that are not served show ``s``: right on red after a stop.
    """
    yellow = round(yellow_s / TICK_S)
    served, cycle = _share_out([[needs[name] for name in names] for names in axes], yellow)
    slack = cycle - sum(axis.window(yellow) + yellow for axis in served)
    greens: dict[tuple[str, str], list[_Interval]] = {}
    start = 0
    for names, axis in zip(axes, served, strict=True):
        width = axis.window(yellow) + min(slack, axis.stretched(yellow) - axis.window(yellow))
        slack -= width - axis.window(yellow)
        for position, turn, interval in axis.intervals(start, width, yellow):
            if turn in needs[names[position]].exits and interval[0] < interval[1]:
                greens.setdefault((names[position], turn), []).append(interval)
        start += width + yellow
    return _compile(greens, needs, cycle, yellow)


def _share_out(axes: list[list[Need]], yellow: int) -> tuple[list[_Axis], int]:
    """Choose the cycle and the times of each approach."""
    share = sum(max(_core_share(need) for need in needs) for needs in axes)
    shared = [len(needs) == 2 and all(need.has_left_phase for need in needs) for needs in axes]
    wanted = _cycle(share, yellow * (len(axes) + sum(shared)))
    if wanted > MAX_CYCLE_S / TICK_S:
        shared = [False] * len(axes)
        wanted = _cycle(share, yellow * len(axes))
    shortest = max(MIN_CYCLE_S, MIN_GREEN_S / min(_core_share(need) for needs in axes for need in needs))
    cycle = min(max(wanted, shortest / TICK_S), MAX_CYCLE_S / TICK_S)
    served = [
        _Axis([_serve(need, cycle) for need in needs], together) for needs, together in zip(axes, shared, strict=True)
    ]
    for axis in served:
        cores = [member.core for member in axis.members]
        if max(cores) - min(cores) <= SNAP_S / TICK_S:
            for member in axis.members:
                member.core = round(sum(cores) / len(cores))
    if wanted > cycle:
        _squeeze(served, round(cycle), yellow)
    needed = sum(axis.window(yellow) + yellow for axis in served)
    return served, max(needed, round(cycle)) if wanted < cycle else needed


def _core_share(need: Need) -> float:
    return need.green_share * (1.0 - OVERLAP_SHARE if need.has_overlap else 1.0)


def _cycle(share: float, lost: int) -> float:
    """Return the ticks of a cycle that holds ``share`` of itself and ``lost`` ticks; infinite where it cannot."""
    return lost / (1.0 - share) if share < 1.0 else math.inf


def _serve(need: Need, cycle: float) -> _Served:
    total = round(cycle * need.green_share)
    overlap = round(OVERLAP_SHARE * total) if need.has_overlap else 0
    return _Served(need, total - overlap, overlap, need.has_left_phase)


def _squeeze(served: list[_Axis], cycle: int, yellow: int) -> None:
    """Fit the axes into the cycle: what does not fit becomes right-turn overlap where possible, else it is cut."""
    budget = cycle - yellow * len(served)
    wanted = [max(member.core for member in axis.members) for axis in served]
    least = [
        max(round(member.core * (MIN_CORE_SHARE if member.need.may_overlap else 1.0)) for member in axis.members)
        for axis in served
    ]
    if sum(least) <= budget:
        part = (budget - sum(least)) / max(sum(wanted) - sum(least), 1)
        windows = [int(low + part * (high - low)) for low, high in zip(least, wanted, strict=True)]
    else:
        windows = [low * budget // sum(least) for low in least]
    for axis, window in zip(served, windows, strict=True):
        for member in axis.members:
            excess = member.core - window
            if excess <= 0:
                continue
            member.core = window
            if member.need.may_overlap:
                member.overlap = min(member.overlap + excess, cycle - window - yellow)
                member.left_phase = member.left_phase and member.need.phase_count >= 3


def _compile(
    greens: Mapping[tuple[str, str], list[_Interval]], needs: Mapping[str, Need], cycle: int, yellow: int
) -> SignalPlan:
    """Turn green intervals per movement into phases."""
    cuts = {0}
    for intervals in greens.values():
        for start, end in intervals:
            cuts |= {start % cycle, end % cycle, (end + yellow) % cycle}
    edges = [*sorted(cuts), cycle]
    phases: list[SignalPhase] = []
    for low, high in itertools.pairwise(edges):
        states = _states(greens, needs, cycle, yellow, low)
        if phases and phases[-1].states == states:
            phases[-1] = SignalPhase(phases[-1].duration_s + (high - low) * TICK_S, states)
        else:
            phases.append(SignalPhase((high - low) * TICK_S, states))
    return SignalPlan(tuple(phases))


def _states(
    greens: Mapping[tuple[str, str], list[_Interval]], needs: Mapping[str, Need], cycle: int, yellow: int, tick: int
) -> tuple[tuple[str, str, str], ...]:
    """Return the colours at ``tick``: ``g`` instead of ``G`` where a movement must yield to another green one."""
    shown: dict[tuple[str, str], str] = {}
    for movement, intervals in greens.items():
        if any((tick - start) % cycle < end - start for start, end in intervals):
            shown[movement] = "G"
        elif any((tick - end) % cycle < yellow for _, end in intervals):
            shown[movement] = "y"
    lines = [
        (name, turn, to, (need.bearing_deg, bearing))
        for name, need in needs.items()
        for turn, exits in need.exits.items()
        for to, bearing in exits
    ]
    going = [(_rank(turn, path), path) for name, turn, _, path in lines if shown.get((name, turn)) == "G"]
    states = []
    for name, turn, to, path in lines:
        colour = shown.get((name, turn), "s" if turn == "r" else "")
        if colour == "G" and any(rank < _rank(turn, path) and conflict(path, other) for rank, other in going):
            colour = "g"
        if colour:
            states.append((name, to, colour))
    return tuple(states)


def _rank(turn: str, path: tuple[float, float]) -> tuple[int, float]:
    """Order of right of way: straight, right, left; among equals the one that bends less."""
    return _PRIORITY[turn], abs(deflection_deg(*path))


def measure(plan: SignalPlan, leg: str) -> tuple[int, float]:
    """Return the phase count and green share that ``plan`` gives the approach from ``leg``, counted as published."""
    green_s, patterns = 0.0, set()
    for phase in plan.phases:
        green = frozenset(to for start, to, colour in phase.states if start == leg and colour in "Gg")
        if green:
            green_s += phase.duration_s
            patterns.add(green)
    return len(patterns), green_s / plan.cycle_s
