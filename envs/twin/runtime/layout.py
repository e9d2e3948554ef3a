"""Layout of the twin's arrays: the net, the traffic of an episode, and the state of one environment.

Tables have one record per lane, link or vehicle: ``vehicles[v].speed`` in compiled code, ``vehicles["speed"][v]`` in
NumPy. Lengths are in m, speeds in m/s, times in ms. ``L`` lanes (sources and inside lanes too), ``E`` edges,
``K`` links, ``R`` routes, ``T`` signal programs, ``N`` vehicles of the demand (row ``k`` is the vehicle that SUMO calls
``str(k)``), ``I`` items: links that vehicles see ahead. -1 means none.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from izoo.envs.tables import Byte1, Float1, Float2, Int1, Int2, Int3, Long1, opener, tables_type

MAX_ROUTE_EDGES = 6


def _record(*groups: str, size: int = 0) -> np.dtype:
    """Return the type of a record of ``size`` bytes, or of as many as it takes.

    Args:
        groups: type and names of fields, in the order of the memory.
    """
    fields = [(name, kind) for kind, *names in map(str.split, groups) for name in names]
    kind = np.dtype(fields, align=True)
    spare = size - kind.itemsize
    return np.dtype([*fields, ("spare", "u1", (spare,))], align=True) if spare > 0 else kind


Lane = _record(
    "f8 length limit",
    "i4 edge index right left inside region junction first_link links",
    size=64,
)
"""Length; speed limit; edge; 0 is rightmost; neighbouring lanes of the edge; 1 inside a junction; row of
:class:`~izoo.networks.road.RoadNet`; junction at the lane's end, of inside lanes the one that they are in; its links
are the rows ``first_link`` to ``first_link + links``."""
Edge = _record("i4 first_lane lanes inside changes")
"""The lanes of an edge are neighbouring rows, rightmost first; ``changes``: vehicles may change lanes."""
Link = _record(
    "i4 from_lane to_lane via_lane next_lane junction request cont program signal state direction entry",
    "i4 first_response responses first_foe foes first_conflict conflicts first_wait waits",
)
"""Lane before; lane behind the junction; first inside lane, -1 where there is none; the lane that comes next (via, else
to); junction; number in the junction's request table; 1 where vehicles may wait inside the junction; signal program;
index in the program's states; state letter where no signal shows one; letter of the direction; for a link that begins
inside a junction the link by which vehicles come in, otherwise itself. Then ranges: links that it yields to, foes,
conflicts of the way that it ends, and links whose vehicles it yields to at a waiting point."""
Program = _record("i8 first_phase phases cycle_ms offset_ms")
Phase = _record("i8 begin_ms state")
"""Begin within the cycle; where its state begins in ``phase_letters``."""
Best = _record("f8 length", "i2 offset link road", "u1 open")
"""See :class:`~izoo.envs.twin.net.best_lanes.BestTables`."""
Route = _record("i4 exit_edge first_variant variants")
"""Row of the last edge; its variants are the rows from ``first_variant`` on of :attr:`TwinNet.best`."""
Conflict = _record("f8 to_end size foe_to_end foe_size radius", "i4 lane entry kind yields foe_yields foe_waits")
"""Of a way through a junction with another: metres from the begin of the conflict to the end of the own way; length of
a crossing on it, else 0; the same on the other way (:data:`~izoo.envs.twin.net.conflicts.NOWHERE` where that way ends
before the own); radius of the own turn, 0 on straight ways and in sharp right turns, where SUMO does not use it. The
other way; the link by which vehicles enter it; kind; 1 where the own entry link yields to that link; 1 where that link
yields to the own; 1 where the other way ends at a waiting point."""


class TwinNet(NamedTuple):
    """Arrays of a whole net; constant, shared by all environments that play it.

    Attributes:
        lanes, edges, links, programs, phases, routes, conflicts: records of the types above.
        best: ``[X, L]``, a row per variant of a route.
        responses: links that a link must yield to. foes: links whose ways conflict with a link's. Both int32, in the
            ranges that ``links`` give; entries are rows of links that begin outside of the junction, or, of an
            inner wait, the link that leaves it. wait_foes: int32.
        phase_letters: uint8, ASCII.
        program_first_link: ``[T + 1]`` int32, range of each program in ``program_links``. program_links: int32, the
            links that show a program.
        route_edges: ``[R, MAX_ROUTE_EDGES]`` int32, source edge to exit edge, then -1; inside edges are left out.
        source_lanes: int32, rows of the lanes to enter on.
        route_of: ``[P, 2, Q]`` int32, the route by approach, source kind, exit.
        route_link: ``[R, L]`` int32, the link by which a vehicle of the route leaves the lane; -1 where the lane does
            not lead on (or the route ends).
        variant_links, variant_group: ``[R, 12]`` int32; variant_bits: ``[X]`` int64: see
            :class:`~izoo.envs.twin.net.best_lanes.BestTables`.
        incoming_start: ``[L + 1]`` int32, each lane's range of incoming_links (int32), the links that lead to it.
    """

    lanes: Annotated[np.ndarray, Lane, 1]
    edges: Annotated[np.ndarray, Edge, 1]
    links: Annotated[np.ndarray, Link, 1]
    programs: Annotated[np.ndarray, Program, 1]
    phases: Annotated[np.ndarray, Phase, 1]
    routes: Annotated[np.ndarray, Route, 1]
    conflicts: Annotated[np.ndarray, Conflict, 1]
    best: Annotated[np.ndarray, Best, 2]
    responses: Int1
    foes: Int1
    wait_foes: Int1
    phase_letters: Byte1
    program_first_link: Int1
    program_links: Int1
    route_edges: Int2
    source_lanes: Int1
    route_of: Int3
    route_link: Int2
    variant_links: Annotated[np.ndarray, "int32", 2, 12]
    variant_group: Annotated[np.ndarray, "int32", 2, 12]
    variant_bits: Long1
    incoming_start: Int1
    incoming_links: Int1


Driver = _record(
    "f8 length min_gap tau max_accel decel emergency_decel two_root_ab depart_speed", "i8 depart_ms route depart_lane"
)
"""Of a vehicle: its length; standstill gap; reaction time (s); accelerations (m/s^2); ``2 sqrt(accel decel)``; speed on
entering; time at which it wants to enter; route; row of the source lane."""
Fleet = _record("f8 decel min_gap from_ms")
"""Least deceleration (m/s^2) and largest standstill gap of the vehicles that SUMO has read from the route file, and
since when; it reads it in portions."""


class TwinTraffic(NamedTuple):
    """The demand of an episode; constant.

    Attributes:
        drivers: ``[N]``, as SUMO reads them from the route file (rounded to its decimals).
        fleet: ``[F]``, a record for each portion that SUMO reads, by time.
    """

    drivers: Annotated[np.ndarray, Driver, 1]
    fleet: Annotated[np.ndarray, Fleet, 1]


NOT_YET, WAITING, DRIVING, ARRIVED, DROPPED = range(5)
"""Values of ``status``: not yet due; due but not inserted; on the road; at the end of its route; removed by SUMO."""

Vehicle = _record(
    "f8 position speed accel free_speed command blocker_length left_space top_speed",
    "i4 status lane ahead behind variant tail_lanes first_item items waiting_ms has_to_wait advices",
    "i4 change_command change_mode change_state change_until_ms signals",
    "f8 look_ahead_speed speed_gain speed_gain_right keep_right",
    "i4 change_target junction_ms conflict_ms will_pass stood_for entered_ms",
    size=192,
)
"""Front bumper on its lane; speed; acceleration of the last step; speed that SUMO itself would have chosen in the last
step ("speed without TraCI"); commanded speed, NaN for none; two of lane changing's memories; the vehicle's maximum
speed. Status; lane; next vehicle downstream and upstream on its lane; row of the best lanes' tables, set when it enters
an edge; lanes behind its own that its tail is on; its items; how long it has stood; 1 where something keeps it from
going on; speeds advised. Of lane changing: commanded change of this step (-1 right, 0 none, 1 left), lane change mode,
SUMO-like state bits, until when it is commanded to a lane; SUMO's signals; the other memories; index of the lane that
it is commanded to. Since when it has its turn in its junction, and is in that junction's conflicts (NEVER_MS
before, and when it has lost its turn, which it has again past its waiting point); 1 where it asked to pass the link at
the end of its lane in the last plan; the link with ``s`` that it stood before; when it entered the junction, whatever
became of its turn. The first eight and the next sixteen fields are lines of the processor's cache."""
Queue = _record("i4 front back count tails")
"""The vehicle furthest downstream and upstream with its front on the lane; how many there are; how many vehicles have
their tail, but not their front, on it."""
Item = _record(
    "f8 distance pass_speed wait_speed arrival_speed leave_speed braked_speed passage space",
    "i8 link vehicle arrival_ms leave_ms request next",
    size=128,
)
"""What a vehicle plans at a link: distance from its front to the link; speed for the coming step if the link is passed,
and if not; speed on arrival and on leaving the way behind it; speed on arrival if the vehicle brakes at once; length of
that way and of the vehicle; room behind the link up to the first vehicle that stands there. Link; vehicle; time of
arrival at the link and of leaving the junction; 1 where the vehicle asks to pass; next item of the same link."""
Clock = _record("i8 now_ms steps next_departure items on_road lost_tails first_active last_active")
"""Time at which the coming step begins; steps done; first vehicle that was not due yet; items in use; vehicles on the
road; how often a tail found no room (:data:`MAX_TAIL_LANES`); first and last lane in the order of busy lanes."""
Changer = _record("i4 next first_blocked last_blocked", size=32)
"""Working memory of lane changing on an edge."""
Active = _record("i4 next previous served", size=16)
"""Lanes after and before it in the order of :mod:`izoo.envs.twin.driving.active_lanes`; of an edge's first lane, the
step in which its vehicles changed lanes last."""

MAX_TAIL_LANES = 4
"""Lanes behind its own that a tail can be on, and tails that one lane can hold."""
MAX_ITEMS_PER_VEHICLE = 8
NEVER_MS = (1 << 31) - 1
MAX_ADVICES = 12
"""Speeds that lane changing advises to one vehicle within a step."""
MAX_LANES_SEEN = 8
"""Lanes side by side inside a junction of which a driver remembers how full the roads behind them were."""
NOT_ACTIVE = -2
"""``next`` of lanes that are not in the order of :attr:`TwinState.active`."""


class TwinState(NamedTuple):
    """All that changes in one environment: plain arrays of fixed size, so that a copy of them is a copy of the world.

    Attributes:
        clock: one record.
        vehicles: ``[N]``.
        tail_lane: ``[N, MAX_TAIL_LANES]`` int32, lanes that the vehicle's tail is on, nearest to its front first.
        lanes: ``[L]``.
        tails: ``[L, MAX_TAIL_LANES]`` int32, vehicles with their tail on the lane.
        waiting_first, waiting_last: ``[L]`` int32, vehicles that wait to enter a lane. waiting_next: ``[N]`` int32.
        link_letter: ``[K]`` uint8, what the link shows now (``G g y r s``, or its state without signal).
        program_switch_ms: ``[T]`` int64, when the present phase ends.
        advice: ``[N, MAX_ADVICES]`` float64, speeds (m/s) advised in the last lane changing.
        room_seen: ``[N, S]`` float64, road (m) taken behind the junction, for each lane inside it; ``S`` is the most
            of the net's, 1 to :data:`MAX_LANES_SEEN`.
        active: ``[L]``, the order in which lanes are served.

    The others are working memory of a step (:data:`WORKING`), which environments share: nothing in it lasts.
        link_first: ``[K]`` int32, first item of the vehicles that approach the link.
        items: ``[I]``.
        changer: ``[L]``. changer_density: ``[L]`` float64. changer_queue: ``[32]`` int32. changer_way: ``[32]``
            float64: of lane changing.
        lane_room: ``[L]`` float64, length and minGap of the vehicles with their front on the lane, in m; set when
            lanes are changed. lane_room_before: the same as the step begins.
        moved: ``[N]`` int32, which have left their lane.
    """

    clock: Annotated[np.ndarray, Clock, 0]
    vehicles: Annotated[np.ndarray, Vehicle, 1]
    tail_lane: Annotated[np.ndarray, "int32", 2, MAX_TAIL_LANES]
    lanes: Annotated[np.ndarray, Queue, 1]
    tails: Annotated[np.ndarray, "int32", 2, MAX_TAIL_LANES]
    waiting_first: Int1
    waiting_last: Int1
    waiting_next: Int1
    link_letter: Byte1
    program_switch_ms: Long1
    advice: Annotated[np.ndarray, "float64", 2, MAX_ADVICES]
    room_seen: Float2
    active: Annotated[np.ndarray, Active, 1]
    link_first: Int1
    items: Annotated[np.ndarray, Item, 1]
    changer: Annotated[np.ndarray, Changer, 1]
    changer_density: Float1
    changer_queue: Int1
    changer_way: Float1
    lane_room: Float1
    lane_room_before: Float1
    moved: Int1


WORKING = TwinState._fields[TwinState._fields.index("link_first") :]
"""Arrays of :class:`TwinState` in which nothing lasts from step to step."""

NET, TRAFFIC = tables_type(TwinNet, constant=True), tables_type(TwinTraffic, constant=True)
STATE = tables_type(TwinState)
open_net, open_traffic, open_state = opener(NET), opener(TRAFFIC), opener(STATE)
