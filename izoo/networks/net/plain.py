"""An :class:`IntersectionSpec` as SUMO plain XML: nodes, edges, connections and signal programs.

Names follow the published dataset: signal ``TL``, ghost junction ``A``, approach ``A2TL`` and, behind the node
``A_intern``, its pocket part ``A2TL_intern``, exit ``TL2A``, sources ``AB2A`` (straight) and ``AA2A`` (turning in).
Coordinates are in m with ``TL`` at the origin, x to the east and y to the north;
heights come later (:mod:`izoo.networks.net.heights`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from izoo.contexts.spec import Approach, IntersectionSpec, Leg, SignalPlan
from izoo.errors import IzooError
from izoo.networks.net.connections import Link, signal_links
from izoo.networks.net.ghosts import ghost_program
from izoo.networks.net.programs import main_phases

LANE_WIDTH_M = 3.2
JOINT_M = 8.0
"""Length of the lanes between the main and the pocket part of an approach, as in the dataset."""
MIN_PART_M = 2.0
GATE_PHASES = ((82.0, "G"), (3.0, "y"), (5.0, "r"))
_CORNER_M, _MAX_CLEARANCE_M = 4.0, 60.0


@dataclass(frozen=True)
class _Node:
    name: str
    type: str
    x_m: float
    y_m: float

    def xml(self) -> str:
        signal = f' tl="{self.name}"' if self.type.startswith("traffic_light") else ""
        return f'<node id="{self.name}" x="{self.x_m:.6f}" y="{self.y_m:.6f}" type="{self.type}"{signal}/>'


@dataclass(frozen=True)
class _Edge:
    """An edge; ``length_m`` overrides the drawn length."""

    start: str
    end: str
    lanes: int
    speed_mps: float
    length_m: float | None = None

    @property
    def name(self) -> str:
        if self.end.endswith("_intern"):
            return f"{self.start}2TL"
        return f"{self.start[0]}2TL_intern" if self.start.endswith("_intern") else f"{self.start}2{self.end}"

    def xml(self) -> str:
        length = "" if self.length_m is None else f' length="{self.length_m:.6f}"'
        return (
            f'<edge id="{self.name}" from="{self.start}" to="{self.end}" priority="-1" numLanes="{self.lanes}" '
            f'speed="{self.speed_mps:.6f}"{length}/>'
        )


@dataclass(frozen=True)
class _Connection:
    """A lane connection; with ``signal``, link ``index`` of that signal controls it."""

    start: str
    start_lane: int
    end: str
    end_lane: int
    signal: str | None = None
    index: int = 0
    length_m: float | None = None

    def _ends(self) -> str:
        return f'from="{self.start}" to="{self.end}" fromLane="{self.start_lane}" toLane="{self.end_lane}"'

    def xml(self) -> str:
        length = "" if self.length_m is None else f' length="{self.length_m:.6f}"'
        return f"<connection {self._ends()}{length}/>"

    def signal_xml(self) -> str:
        return f'<connection {self._ends()} tl="{self.signal}" linkIndex="{self.index}"/>'


@dataclass(frozen=True)
class _Program:
    signal: str
    offset_s: float
    phases: tuple[tuple[float, str], ...]

    def xml(self) -> str:
        phases = "".join(f'<phase duration="{duration:.10g}" state="{state}"/>' for duration, state in self.phases)
        head = f'id="{self.signal}" type="static" programID="0" offset="{self.offset_s:.10g}"'
        return f"<tlLogic {head}>{phases}</tlLogic>"


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
    # Connections come after the programs that they refer to.
    controlled = [link.signal_xml() for link in writer.connections if link.signal is not None]
    no_onward = [f'<connection from="{edge}"/>' for edge in writer.ends]
    return PlainNet(
        nodes=_document("nodes", [node.xml() for node in writer.nodes]),
        edges=_document("edges", [edge.xml() for edge in writer.edges]),
        connections=_document("connections", [link.xml() for link in writer.connections] + no_onward),
        signals=_document("tlLogics", [program.xml() for program in writer.programs] + controlled),
        links=links,
    )


class _Writer:
    """Collects the elements of one net."""

    def __init__(self, spec: IntersectionSpec, plan: SignalPlan, links: tuple[Link, ...]) -> None:
        self.spec, self.plan, self.links = spec, plan, links
        self.exact = spec.source != "procedural"
        self.nodes: list[_Node] = []
        self.edges: list[_Edge] = []
        self.connections: list[_Connection] = []
        self.programs: list[_Program] = []
        self.ends: list[str] = []

    def add_signal(self) -> None:
        """Add the main signal, its links and its program."""
        kind = "traffic_light_right_on_red" if self.spec.right_on_red else "traffic_light"
        self.nodes.append(_Node("TL", kind, 0.0, 0.0))
        for index, link in enumerate(self.links):
            approach = self.spec.leg(link.from_leg).approach
            edge = f"{link.from_leg}2TL_intern" if approach and has_pocket(approach) else f"{link.from_leg}2TL"
            self.connections.append(_Connection(edge, link.from_lane, f"TL2{link.to_leg}", link.to_lane, "TL", index))
        self.programs.append(_Program("TL", self.plan.offset_s, main_phases(self.spec.name, self.plan, self.links)))

    def add_leg(self, leg: Leg) -> None:
        """Add a leg: approach, exit, ghost junction and sources."""
        approach, name = leg.approach, leg.name
        length_m = approach.length_m if approach else leg.exit_length_m
        gap_m = _clearance_m(self.spec, leg) + _ghost_clearance_m(leg) if self.exact else 0.0
        ghost = self._node(name, "traffic_light" if approach else "priority", leg, length_m + gap_m)
        if leg.exit_lanes:
            # Where exit and approach differ in length, the drawing follows the approach.
            own = self.exact or (approach is not None and leg.exit_length_m != approach.length_m)
            out = _Edge("TL", name, leg.exit_lanes, leg.exit_speed_limit_mps, leg.exit_length_m if own else None)
            self.edges.append(out)
            self.ends.append(out.name)
        if approach is not None:
            self._add_approach(leg, approach)
            self._add_ghost(leg, approach, ghost)

    def _node(self, name: str, kind: str, leg: Leg, distance_m: float) -> _Node:
        angle = math.radians(leg.bearing_deg)
        node = _Node(name, kind, distance_m * math.sin(angle), distance_m * math.cos(angle))
        self.nodes.append(node)
        return node

    def _add_approach(self, leg: Leg, approach: Approach) -> None:
        name, speed = leg.name, approach.speed_limit_mps
        main_lanes = approach.main_lane_count
        if not has_pocket(approach):
            self.edges.append(_Edge(name, "TL", main_lanes, speed, approach.length_m if self.exact else None))
            return
        main_m = approach.length_m - approach.pocket_length_m - JOINT_M
        if approach.pocket_length_m < MIN_PART_M or main_m < MIN_PART_M:
            raise IzooError(
                f"intersection {self.spec.name}: approach {name} of {approach.length_m:g} m has turn pockets of "
                f"{approach.pocket_length_m:g} m; pockets take from {MIN_PART_M:g} m to the approach's length less "
                f"{JOINT_M + MIN_PART_M:g} m."
            )
        middle_m = approach.pocket_length_m + (_clearance_m(self.spec, leg) + JOINT_M / 2.0 if self.exact else 0.0)
        self._node(f"{name}_intern", "priority", leg, middle_m)
        self.edges += [
            _Edge(name, f"{name}_intern", main_lanes, speed, main_m if self.exact else None),
            _Edge(f"{name}_intern", "TL", approach.lane_count, speed, approach.pocket_length_m if self.exact else None),
        ]
        for lane in range(main_lanes):
            onward = lane + approach.right_pockets
            low = 0 if lane == 0 else onward
            high = approach.lane_count - 1 if lane == main_lanes - 1 else onward
            for target in range(low, high + 1):
                joint = _Connection(
                    f"{name}2TL", lane, f"{name}2TL_intern", target, length_m=JOINT_M if self.exact else None
                )
                self.connections.append(joint)

    def _add_ghost(self, leg: Leg, approach: Approach, node: _Node) -> None:
        """Add the sources, their signal, and the gates at their outer ends."""
        name, lanes, ghosts = leg.name, approach.main_lane_count, self.spec.ghosts
        # The turning source turns right into the approach.
        ways = (
            ("B", ghosts.straight_source_length_m, math.radians(leg.bearing_deg)),
            ("A", ghosts.turning_source_length_m, math.radians(leg.bearing_deg - 90.0)),
        )
        for number, (letter, given_m, angle) in enumerate(ways):
            outer, length_m = name + letter, approach.length_m if given_m is None else given_m
            if length_m < 10.0:
                raise IzooError(
                    f"intersection {self.spec.name}: ghost source {outer}2{name} is {length_m:g} m; give 10 m or more."
                )
            drawn_m = length_m + (_ghost_clearance_m(leg) if self.exact else 0.0)
            kind = "traffic_light" if ghosts.outer_gates else "priority"
            x_m, y_m = node.x_m + drawn_m * math.sin(angle), node.y_m + drawn_m * math.cos(angle)
            self.nodes.append(_Node(outer, kind, x_m, y_m))
            source = _Edge(outer, name, lanes, approach.speed_limit_mps, length_m if self.exact else None)
            self.edges.append(source)
            for lane in range(lanes):
                index = number * lanes + lane
                self.connections.append(_Connection(source.name, lane, f"{name}2TL", lane, name, index))
            if ghosts.outer_gates:
                self._add_gate(name, outer, lanes, approach.speed_limit_mps)
        program = ghost_program(self.spec, self.plan, name)
        phases = tuple((duration_s, one * lanes + two * lanes) for duration_s, one, two in program.phases)
        self.programs.append(_Program(name, program.offset_s, phases))

    def _add_gate(self, name: str, outer: str, lanes: int, speed_mps: float) -> None:
        """As in the dataset, the gate holds what turns round at the outer end, from an edge that leads there."""
        self.edges.append(_Edge(name, outer, lanes, speed_mps))
        self.connections.append(_Connection(f"{name}2{outer}", lanes - 1, f"{outer}2{name}", lanes - 1, outer))
        self.programs.append(_Program(outer, 0.0, GATE_PHASES))


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
