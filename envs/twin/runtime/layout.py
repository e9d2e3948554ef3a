"""Layout of the twin's arrays: the net, the traffic of an episode, and the state of one environment.

Tables are two-dimensional with one row per lane, link or vehicle; their columns are the constants below. Few tables
instead of many arrays: compiled functions take them by value. ``L`` lanes (sources and inside lanes too), ``E`` edges,
``K`` links, ``R`` routes, ``T`` signal programs, ``N`` vehicles of the demand (row ``k`` is the vehicle that SUMO calls
``str(k)``), ``I`` items: links that vehicles see ahead. -1 means none.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from izoo.envs.twin.runtime.compiled import Byte1, Byte2, Float1, Float2, Int1, Int2, Int3, Long1, opener, tables_type

LANE_LENGTH, LANE_LIMIT = range(2)
"""Columns of :attr:`TwinNet.lane_floats`: length (m), speed limit (m/s)."""

(
    LANE_EDGE,
    LANE_INDEX,
    LANE_RIGHT,
    LANE_LEFT,
    LANE_INSIDE,
    LANE_REGION,
    LANE_JUNCTION,
    LANE_FIRST_LINK,
    LANE_LINKS,
) = range(9)
"""Columns of :attr:`TwinNet.lane_ints`: edge; 0 is rightmost; neighbouring lanes of the edge; 1 inside a junction;
row of :class:`~izoo.networks.road.RoadNet`; junction at the lane's end, of inside lanes the one that they are in; its
links are the rows ``LANE_FIRST_LINK`` to ``LANE_FIRST_LINK + LANE_LINKS`` of the links."""

EDGE_FIRST_LANE, EDGE_LANES, EDGE_INSIDE, EDGE_CHANGES = range(4)
"""Columns of :attr:`TwinNet.edge_ints`: the lanes of an edge are neighbouring rows, rightmost first."""

(
    LINK_FROM,
    LINK_TO,
    LINK_VIA,
    LINK_NEXT,
    LINK_JUNCTION,
    LINK_REQUEST,
    LINK_CONT,
    LINK_PROGRAM,
    LINK_SIGNAL,
    LINK_STATE,
    LINK_DIRECTION,
    LINK_ENTRY,
    LINK_FIRST_RESPONSE,
    LINK_RESPONSES,
    LINK_FIRST_FOE,
    LINK_FOES,
) = range(16)
"""Columns of :attr:`TwinNet.link_ints`: lane before; lane behind the junction; first inside lane, -1 where there is
none; the lane that comes next (via, else to); junction; number in the junction's request table; 1 where vehicles may
wait inside the junction; signal program; index in the program's states; state letter where no signal shows one; letter
of the direction; for a link that begins inside a junction the link by which vehicles come in, otherwise itself; links
that it yields to and foes, as ranges of :attr:`TwinNet.responses` and :attr:`TwinNet.foes`."""

PHASE_BEGIN_MS, PHASE_STATE = range(2)
"""Columns of :attr:`TwinNet.phase_ints`: begin within the cycle; where its state begins in ``phase_letters``."""

PROGRAM_FIRST_PHASE, PROGRAM_PHASES, PROGRAM_CYCLE_MS, PROGRAM_OFFSET_MS = range(4)
"""Columns of :attr:`TwinNet.program_ints`."""

MAX_ROUTE_EDGES = 6


class TwinNet(NamedTuple):
    """Arrays of a whole net; constant, shared by all environments that play it.

    Attributes:
        lane_floats: ``[L, 2]`` float64. lane_ints: ``[L, 9]`` int32.
        edge_ints: ``[E, 4]`` int32.
        link_ints: ``[K, 16]`` int32, sorted by ``LINK_FROM``, then as in the net file.
        responses: links that a link must yield to. foes: links whose ways conflict with a link's. Both int32, in the
            ranges that ``link_ints`` give; entries are rows of links that begin outside of the junction, or, of an
            inner wait, the link that leaves it.
        program_ints: ``[T, 4]`` int64. phase_ints: ``[phases, 2]`` int64. phase_letters: uint8, ASCII.
        program_first_link: ``[T + 1]`` int32, range of each program in ``program_links``. program_links: int32, the
            links that show a program.
        route_edges: ``[R, MAX_ROUTE_EDGES]`` int32, source edge to exit edge, then -1; inside edges are left out.
        route_exit_edge: ``[R]`` int32, row of the last edge. source_lanes: int32, rows of the lanes to enter on.
        route_of: ``[P, 2, Q]`` int32, the route by approach, source kind, exit.
        route_link: ``[R, L]`` int32, the link by which a vehicle of the route leaves the lane; -1 where the lane does
            not lead on (or the route ends).
        variant_first, variant_count: ``[R]`` int32; variant_links, variant_group: ``[R, 12]`` int32; variant_bits:
            ``[X]`` int64; best_length: ``[X, L]`` float64; best_offset, best_link: ``[X, L]`` int32; best_open:
            ``[X, L]`` uint8; best_road: ``[X, L]`` int32: see :class:`~izoo.envs.twin.net.best_lanes.BestTables`.
        incoming_start: ``[L + 1]`` int32, each lane's range of incoming_links (int32), the links that lead to it.
        conflict_first and the rest: see :class:`~izoo.envs.twin.net.conflicts.Conflicts`.
    """

    lane_floats: Annotated[np.ndarray, "float64", 2, 2]
    lane_ints: Annotated[np.ndarray, "int32", 2, 9]
    edge_ints: Annotated[np.ndarray, "int32", 2, 4]
    link_ints: Annotated[np.ndarray, "int32", 2, 16]
    responses: Int1
    foes: Int1
    program_ints: Annotated[np.ndarray, "int64", 2, 4]
    phase_ints: Annotated[np.ndarray, "int64", 2, 2]
    phase_letters: Byte1
    program_first_link: Int1
    program_links: Int1
    route_edges: Int2
    route_exit_edge: Int1
    source_lanes: Int1
    route_of: Int3
    route_link: Int2
    variant_first: Int1
    variant_count: Int1
    variant_links: Annotated[np.ndarray, "int32", 2, 12]
    variant_group: Annotated[np.ndarray, "int32", 2, 12]
    variant_bits: Long1
    best_length: Float2
    best_offset: Int2
    best_link: Int2
    best_open: Byte2
    best_road: Int2
    incoming_start: Int1
    incoming_links: Int1
    conflict_first: Int1
    conflict_count: Int1
    conflict_ints: Int2
    conflict_floats: Float2
    wait_first: Int1
    wait_count: Int1
    wait_foes: Int1


LENGTH, MIN_GAP, TAU, MAX_ACCEL, DECEL, EMERGENCY_DECEL, TWO_ROOT_AB, DEPART_SPEED = range(8)
"""Columns of :attr:`TwinTraffic.floats`: m, m, s, m/s^2, m/s^2, m/s^2, ``2 sqrt(accel decel)``, m/s."""

FLEET_DECEL, FLEET_MIN_GAP, FLEET_FROM_MS = range(3)
"""Columns of :attr:`TwinTraffic.fleet`."""

DEPART_MS, ROUTE, DEPART_LANE = range(3)
"""Columns of :attr:`TwinTraffic.ints`: time at which it wants to enter (ms), route, row of the source lane."""


class TwinTraffic(NamedTuple):
    """The demand of an episode; constant.

    Attributes:
        floats: ``[N, 8]`` float64, as SUMO reads them from the route file (rounded to its decimals).
        ints: ``[N, 3]`` int64.
        fleet: ``[R, 3]`` float64, least deceleration (m/s^2) and largest standstill gap (m) of the vehicles that SUMO
            has read from the route file, and since when (ms); it reads it in portions.
    """

    floats: Annotated[np.ndarray, "float64", 2, 8]
    ints: Annotated[np.ndarray, "int64", 2, 3]
    fleet: Annotated[np.ndarray, "float64", 2, 3]


NOT_YET, WAITING, DRIVING, ARRIVED, DROPPED = range(5)
"""Values of ``STATUS``: not yet due; due but not inserted; on the road; at the end of its route; removed by SUMO."""

(
    POSITION,
    SPEED,
    ACCEL,
    FREE_SPEED,
    COMMAND,
    BLOCKER_LENGTH,
    LEFT_SPACE,
    TOP_SPEED,
    LOOK_AHEAD_SPEED,
    SPEED_GAIN,
    SPEED_GAIN_RIGHT,
    KEEP_RIGHT,
) = range(12)
"""Columns of :attr:`TwinState.floats`: front bumper on its lane (m); m/s; acceleration of the last step (m/s^2); speed
that SUMO itself would have chosen in the last step ("speed without TraCI", m/s); commanded speed (m/s), NaN for none;
two of lane changing's memories; the vehicle's maximum speed (m/s); the other memories. The first eight are a line of
the processor's cache."""

(
    STATUS,
    LANE,
    AHEAD,
    BEHIND,
    VARIANT,
    TAIL_LANES,
    FIRST_ITEM,
    ITEMS,
    WAITING_MS,
    HAS_TO_WAIT,
    ADVICES,
    CHANGE_COMMAND,
    CHANGE_MODE,
    CHANGE_STATE,
    CHANGE_UNTIL_MS,
    SIGNALS,
    CHANGE_TARGET,
    JUNCTION_MS,
    CONFLICT_MS,
    WILL_PASS,
    STOOD_FOR,
    ENTERED_MS,
) = range(22)
"""Columns of :attr:`TwinState.ints`: status; lane; next vehicle downstream and upstream on its lane; row of the best
lanes' tables, set when it enters an edge; lanes behind its own that its tail is on; its items in ``item_*``; how long
it has stood (ms); 1 where something keeps it from going on; speeds advised; lane changing: commanded change of this
step (-1 right, 0 none, 1 left), lane change mode, SUMO-like state bits, until when it is commanded to a lane; SUMO's
signals; index of the lane that it is commanded to; since when it has its turn in the junction that it is in, and is in
that junction's conflicts (NEVER_MS before, and when it has lost its turn, which it has again past its waiting point),
1 where it asked to pass the link at the end of its lane in the last plan, the link with ``s`` that it stood before;
when it entered the junction, whatever became of its turn. The first sixteen are a line of the cache."""

LANE_FRONT, LANE_BACK, LANE_COUNT, LANE_TAILS = range(4)
"""Columns of :attr:`TwinState.lanes`: the vehicle furthest downstream and upstream with its front on the lane; how many
there are; how many vehicles have their tail, but not their front, on it."""

MAX_TAIL_LANES = 4
"""Lanes behind its own that a tail can be on, and tails that one lane can hold."""

(
    ITEM_DISTANCE,
    ITEM_PASS,
    ITEM_WAIT,
    ITEM_ARRIVAL_SPEED,
    ITEM_LEAVE_SPEED,
    ITEM_BRAKED_SPEED,
    ITEM_PASSAGE,
    ITEM_SPACE,
) = range(8)
"""Columns of :attr:`TwinState.item_floats`: distance from the front to the link (m); speed for the coming step if the
link is passed, and if not (m/s); speed on arrival and on leaving the way behind it (m/s); speed
on arrival if the vehicle brakes at once; length of that way and of the vehicle (m); room behind the link up to the
first who stands there (m)."""

ITEM_LINK, ITEM_VEHICLE, ITEM_ARRIVAL_MS, ITEM_LEAVE_MS, ITEM_REQUEST, ITEM_NEXT = range(6)
"""Columns of :attr:`TwinState.item_ints`: link; vehicle; time of arrival at the link and of leaving the junction;
1 where the vehicle asks to pass; next item that approaches the same link."""

NOW_MS, STEP_COUNT, NEXT_DEPARTURE, ITEM_TOTAL, ON_ROAD, LOST_TAILS, ACTIVE_FIRST, ACTIVE_LAST = range(8)
"""Entries of :attr:`TwinState.clock`: time at which the coming step begins (ms); steps done; first vehicle that was not
due yet; items in use; vehicles on the road; how often a tail found no room (:data:`MAX_TAIL_LANES`); first and last
lane in the order of busy lanes."""

MAX_ITEMS_PER_VEHICLE = 8

VEHICLE_FLOATS, VEHICLE_INTS = 16, 32
"""Columns of vehicles' tables, some of them free: rows are whole lines of the processor's cache."""

NEVER_MS = (1 << 31) - 1


MAX_ADVICES = 12
"""Speeds that lane changing advises to one vehicle within a step."""

MAX_LANES_SEEN = 8
"""Lanes side by side inside a junction of which a driver remembers how full the roads behind them were."""

(
    CHANGER_NEXT,
    CHANGER_FIRST_BLOCKED,
    CHANGER_LAST_BLOCKED,
) = range(3)
"""Columns of :attr:`TwinState.changer`, the working memory of lane changing on an edge."""

ACTIVE_NEXT, ACTIVE_PREVIOUS, ACTIVE_SERVED = range(3)
"""Columns of :attr:`TwinState.active`: lanes after and before it in the order of
:mod:`izoo.envs.twin.driving.active_lanes`; of an
edge's first lane, the step in which its vehicles changed lanes last."""

NOT_ACTIVE = -2
"""Value of ``ACTIVE_NEXT`` of lanes that are not in the order."""


class TwinState(NamedTuple):
    """All that changes in one environment: plain arrays of fixed size, so that a copy of them is a copy of the world.

    Attributes:
        clock: ``[8]`` int64.
        floats: ``[N, VEHICLE_FLOATS]`` float64. ints: ``[N, VEHICLE_INTS]`` int32.
        tail_lane: ``[N, MAX_TAIL_LANES]`` int32, lanes that the vehicle's tail is on, nearest to its front first.
        lanes: ``[L, 4]`` int32.
        tails: ``[L, MAX_TAIL_LANES]`` int32, vehicles with their tail on the lane.
        waiting_first, waiting_last: ``[L]`` int32, per lane who waits to enter on it. waiting_next: ``[N]`` int32.
        link_letter: ``[K]`` uint8, what the link shows now (``G g y r s``, or its state without signal).
        program_switch_ms: ``[T]`` int64, when the present phase ends.
        advice: ``[N, MAX_ADVICES]`` float64, speeds (m/s) advised in the last lane changing.
        room_seen: ``[N, MAX_LANES_SEEN]`` float64, road (m) taken behind the junction, for each lane inside it.
        active: ``[L, 4]`` int32, the order in which lanes are served.

    The others are working memory of a step (:data:`WORKING`), which environments share: nothing in it lasts.
        link_first: ``[K]`` int32, first item of the vehicles that approach the link.
        item_floats: ``[I, 8]`` float64. item_ints: ``[I, 8]`` int64.
        changer: ``[L, 8]`` int32. changer_density: ``[L]`` float64. changer_queue: ``[32]`` int32. changer_way:
            ``[32]`` float64: of lane changing.
        lane_room: ``[L]`` float64, length and minGap of the vehicles with their front on the lane, in m; set when
            lanes are changed. lane_room_before: the same as the step begins.
        moved: ``[N]`` int32, who has left his lane.
    """

    clock: Long1
    floats: Annotated[np.ndarray, "float64", 2, VEHICLE_FLOATS]
    ints: Annotated[np.ndarray, "int32", 2, VEHICLE_INTS]
    tail_lane: Annotated[np.ndarray, "int32", 2, MAX_TAIL_LANES]
    lanes: Annotated[np.ndarray, "int32", 2, 4]
    tails: Annotated[np.ndarray, "int32", 2, MAX_TAIL_LANES]
    waiting_first: Int1
    waiting_last: Int1
    waiting_next: Int1
    link_letter: Byte1
    program_switch_ms: Long1
    advice: Annotated[np.ndarray, "float64", 2, MAX_ADVICES]
    room_seen: Annotated[np.ndarray, "float64", 2, MAX_LANES_SEEN]
    active: Annotated[np.ndarray, "int32", 2, 4]
    link_first: Int1
    item_floats: Annotated[np.ndarray, "float64", 2, 8]
    item_ints: Annotated[np.ndarray, "int64", 2, 8]
    changer: Annotated[np.ndarray, "int32", 2, 8]
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
