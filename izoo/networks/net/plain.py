"""An :class:`IntersectionSpec` as SUMO plain XML: nodes, edges, connections and signal programs.

Names follow the published dataset: signal ``TL``, ghost junction ``A``, approach ``A2TL`` and, behind the node
``A_intern``, its pocket part ``A2TL_intern``, exit ``TL2A``, sources ``AB2A`` (straight) and ``AA2A`` (turning in).
Coordinates are in m with ``TL`` at the origin, x to the east and y to the north;
heights come later (:mod:`izoo.networks.net.heights`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from izoo.contexts.spec import Approach, IntersectionSpec, Leg, SignalPlan
from izoo.errors import IzooError
from izoo.networks.net.connections import Link, signal_links
from izoo.networks.net.programs import ghost_program, main_phases

LANE_WIDTH_M = 3.2
JOINT_M = 8.0
"""Length of the lanes between the main and the pocket part of an approach, as in the dataset."""
MIN_PART_M = 2.0
GATE_PHASES = ((82.0, "G"), (3.0, "y"), (5.0, "r"))
_CORNER_M, _MAX_CLEARANCE_M = 4.0, 60.0


@dataclass(frozen=True)
class PlainNet:
    """The four plain XML documents, and the links of ``TL`` in the order of their indices."""

    nodes: str
    edges: str
    connections: str
    signals: str
    links: tuple[Link, ...]


def plain_net(spec: IntersectionSpec, plan: SignalPlan) -> PlainNet:
    """Write ``spec`` with the fixed-time ``plan`` as plain XML.

    In procedural worlds lengths are node to node; in all others they are those of the lanes, so that an approach has
    exactly its ``length_m`` up to the stop line.

    Raises:
        IzooError: lengths, lanes, ghosts or plan contradict each other.
    """
    links = signal_links(spec)
    writer = _Writer(spec, plan, links)
    writer.add_signal()
    for leg in spec.legs:
        writer.add_leg(leg)
    return PlainNet(
        nodes=_document("nodes", writer.nodes),
        edges=_document("edges", writer.edges),
        connections=_document("connections", writer.connections + writer.ends),
        # Connections come after the programs that they refer to.
        signals=_document("tlLogics", writer.programs + writer.controlled),
        links=links,
    )


class _Writer:
    """Collects the elements of one net."""

    def __init__(self, spec: IntersectionSpec, plan: SignalPlan, links: tuple[Link, ...]) -> None:
        self.spec, self.plan, self.links = spec, plan, links
        self.exact = spec.source != "procedural"
        self.nodes: list[str] = []
        self.edges: list[str] = []
        self.connections: list[str] = []
        self.controlled: list[str] = []
        self.programs: list[str] = []
        self.ends: list[str] = []

    def add_signal(self) -> None:
        """Add the main signal, its links and its program."""
        self._node("TL", "traffic_light_right_on_red" if self.spec.right_on_red else "traffic_light", 0.0, 0.0)
        for index, link in enumerate(self.links):
            approach = self.spec.leg(link.from_leg).approach
            edge = f"{link.from_leg}2TL_intern" if approach and has_pocket(approach) else f"{link.from_leg}2TL"
            self._connect(edge, link.from_lane, f"TL2{link.to_leg}", link.to_lane, tl="TL", linkIndex=index)
        self._program("TL", self.plan.offset_s, main_phases(self.spec.name, self.plan, self.links))

    def add_leg(self, leg: Leg) -> None:
        """Add a leg: approach, exit, ghost junction and sources."""
        approach, name = leg.approach, leg.name
        length_m = approach.length_m if approach else leg.exit_length_m
        gap_m = _clearance_m(self.spec, leg) + _ghost_clearance_m(leg) if self.exact else 0.0
        x_m, y_m = _place(leg.bearing_deg, length_m + gap_m)
        self._node(name, "traffic_light" if approach else "priority", x_m, y_m)
        if leg.exit_lanes:
            # Where exit and approach differ in length, the drawing follows the approach.
            own = self.exact or (approach is not None and leg.exit_length_m != approach.length_m)
            lanes, limit = leg.exit_lanes, leg.exit_speed_limit_mps
            self._edge(f"TL2{name}", "TL", name, lanes, limit, leg.exit_length_m if own else None)
            self.ends.append(_element("connection", {"from": f"TL2{name}"}))
        if approach is not None:
            self._add_approach(leg, approach)
            self._add_ghost(leg, approach, x_m, y_m)

    def _add_approach(self, leg: Leg, approach: Approach) -> None:
        name, speed = leg.name, approach.speed_limit_mps
        main_lanes = approach.main_lane_count
        if not has_pocket(approach):
            self._edge(f"{name}2TL", name, "TL", main_lanes, speed, approach.length_m if self.exact else None)
            return
        pocket_m = approach.pocket_length_m
        main_m = approach.length_m - pocket_m - JOINT_M
        if pocket_m < MIN_PART_M or main_m < MIN_PART_M:
            raise IzooError(
                f"intersection {self.spec.name}: approach {name} of {approach.length_m:g} m has turn pockets of "
                f"{pocket_m:g} m; pockets take from {MIN_PART_M:g} m to the approach's length less "
                f"{JOINT_M + MIN_PART_M:g} m."
            )
        middle_m = pocket_m + (_clearance_m(self.spec, leg) + JOINT_M / 2.0 if self.exact else 0.0)
        self._node(f"{name}_intern", "priority", *_place(leg.bearing_deg, middle_m))
        self._edge(f"{name}2TL", name, f"{name}_intern", main_lanes, speed, main_m if self.exact else None)
        stop = f"{name}2TL_intern"
        self._edge(stop, f"{name}_intern", "TL", approach.lane_count, speed, pocket_m if self.exact else None)
        for lane in range(main_lanes):
            onward = lane + approach.right_pockets
            low = 0 if lane == 0 else onward
            high = approach.lane_count - 1 if lane == main_lanes - 1 else onward
            for target in range(low, high + 1):
                self._connect(f"{name}2TL", lane, stop, target, length_m=JOINT_M if self.exact else None)

    def _add_ghost(self, leg: Leg, approach: Approach, x_m: float, y_m: float) -> None:
        """Add the sources, their signal, and the gates at their outer ends; the ghost lies at ``x_m``, ``y_m``."""
        name, lanes, ghosts = leg.name, approach.main_lane_count, self.spec.ghosts
        # The turning source turns right into the approach.
        ways = (
            ("B", ghosts.straight_source_length_m, leg.bearing_deg),
            ("A", ghosts.turning_source_length_m, leg.bearing_deg - 90.0),
        )
        for number, (letter, given_m, bearing_deg) in enumerate(ways):
            outer, length_m = name + letter, approach.length_m if given_m is None else given_m
            if length_m < 10.0:
                raise IzooError(
                    f"intersection {self.spec.name}: ghost source {outer}2{name} is {length_m:g} m; give 10 m or more."
                )
            east_m, north_m = _place(bearing_deg, length_m + (_ghost_clearance_m(leg) if self.exact else 0.0))
            self._node(outer, "traffic_light" if ghosts.outer_gates else "priority", x_m + east_m, y_m + north_m)
            source, speed = f"{outer}2{name}", approach.speed_limit_mps
            self._edge(source, outer, name, lanes, speed, length_m if self.exact else None)
            for lane in range(lanes):
                self._connect(source, lane, f"{name}2TL", lane, tl=name, linkIndex=number * lanes + lane)
            if ghosts.outer_gates:
                # As in the dataset, the gate holds what turns round at the outer end, from an edge that leads there.
                self._edge(f"{name}2{outer}", name, outer, lanes, speed)
                self._connect(f"{name}2{outer}", lanes - 1, source, lanes - 1, tl=outer, linkIndex=0)
                self._program(outer, 0.0, GATE_PHASES)
        program = ghost_program(self.spec, self.plan, name)
        phases = tuple((duration_s, one * lanes + two * lanes) for duration_s, one, two in program.phases)
        self._program(name, program.offset_s, phases)

    def _node(self, name: str, kind: str, x_m: float, y_m: float) -> None:
        signal = {"tl": name} if kind.startswith("traffic_light") else {}
        self.nodes.append(_element("node", {"id": name, "x": f"{x_m:.6f}", "y": f"{y_m:.6f}", "type": kind, **signal}))

    def _edge(
        self, name: str, start: str, end: str, lanes: int, speed_mps: float, length_m: float | None = None
    ) -> None:
        """Add an edge; ``length_m`` overrides the drawn length."""
        ends = {"id": name, "from": start, "to": end, "priority": -1, "numLanes": lanes, "speed": f"{speed_mps:.6f}"}
        self.edges.append(_element("edge", ends | _length(length_m)))

    def _connect(
        self, start: str, start_lane: int, end: str, end_lane: int, *, length_m: float | None = None, **signal: Any
    ) -> None:
        """Add a lane connection; one with a ``signal`` (``tl`` and ``linkIndex``) is controlled by it."""
        ends = {"from": start, "to": end, "fromLane": start_lane, "toLane": end_lane}
        self.connections.append(_element("connection", ends | _length(length_m)))
        self.controlled += [_element("connection", ends | signal)] if signal else []

    def _program(self, signal: str, offset_s: float, phases: Sequence[tuple[float, str]]) -> None:
        head = {"id": signal, "type": "static", "programID": 0, "offset": f"{offset_s:.10g}"}
        shown = [_element("phase", {"duration": f"{duration:.10g}", "state": state}) for duration, state in phases]
        self.programs.append(_element("tlLogic", head).removesuffix("/>") + f">{''.join(shown)}</tlLogic>")


def _element(tag: str, attributes: Mapping[str, Any]) -> str:
    words = [f'{name}="{value}"' for name, value in attributes.items()]
    return f"<{tag} {' '.join(words)}/>"


def _length(length_m: float | None) -> dict[str, str]:
    return {} if length_m is None else {"length": f"{length_m:.6f}"}


def _place(bearing_deg: float, distance_m: float) -> tuple[float, float]:
    """Metres east and north of where a bearing begins."""
    angle = math.radians(bearing_deg)
    return distance_m * math.sin(angle), distance_m * math.cos(angle)


def has_pocket(approach: Approach) -> bool:
    """Whether the approach is split into a main and a pocket part."""
    return approach.right_pockets + approach.left_pockets > 0


def _clearance_m(spec: IntersectionSpec, leg: Leg) -> float:
    """Estimate how far from its centre the junction reaches along a leg: where road borders meet, plus the corner."""
    reach = [0.0]
    for other in spec.legs:
        for one, two in ((leg, other), (other, leg)):
            angle = math.radians((two.bearing_deg - one.bearing_deg) % 360.0)
            if 0.0 < angle < math.pi:
                # Exits lie on the clockwise side of a leg, approaches on the other.
                leaving, entering = one.exit_lanes * LANE_WIDTH_M, _lanes(two) * LANE_WIDTH_M
                own, beside = (leaving, entering) if one is leg else (entering, leaving)
                reach.append((beside + own * math.cos(angle)) / math.sin(angle))
    return min(max(reach) + _CORNER_M, _MAX_CLEARANCE_M)


def _ghost_clearance_m(leg: Leg) -> float:
    return _lanes(leg) * LANE_WIDTH_M + _CORNER_M


def _lanes(leg: Leg) -> int:
    return leg.approach.lane_count if leg.approach else 0


def _document(root: str, elements: list[str]) -> str:
    return "\n".join([f"<{root}>", *elements, f"</{root}>", ""])
