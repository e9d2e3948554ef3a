"""The twin driven alongside SUMO: after every step, vehicles that differ are moved to where SUMO has them.

A free comparison (:mod:`izoo.benchmarks.fidelity.single_vehicle`) ends with the first difference, since all later ones
may follow from it. Here each difference is one step old, so that a single episode shows all causes.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from izoo.benchmarks.fidelity.single_vehicle import Case, Trace
from izoo.envs.tables import compiled
from izoo.envs.twin.driving.lane_queues import insert_into_lane, remove_from_lane, set_tail
from izoo.envs.twin.lane_change.cooperation import clear_memories
from izoo.envs.twin.lane_change.downstream_occupancy import remember_downstream_occupancy
from izoo.envs.twin.net.best_lanes import find_variant
from izoo.envs.twin.net.reader import twin_traffic
from izoo.envs.twin.runtime.layout import (
    ARRIVED,
    DRIVING,
    DROPPED,
    MAX_TAIL_LANES,
    NEVER_MS,
    WAITING,
    open_net,
    open_state,
    open_traffic,
)
from izoo.envs.twin.runtime.simulation import TwinEpisode
from izoo.networks.road import read_road

TOLERANCE = 1e-3
"""Differences up to this are left as they are."""
ROUNDING = 1e-9
"""Differences (m, m/s) up to this are rounding."""


class Place(NamedTuple):
    """Lane (row, -1 off the road), position (m) and speed (m/s) of a vehicle."""

    lane: int
    position_m: float
    speed_mps: float


class Difference(NamedTuple):
    """Where a vehicle is after a step, in SUMO and on the twin."""

    step: int
    vehicle: int
    sumo: Place
    twin: Place


def differences(case: Case, sumo: Trace) -> Iterator[Difference]:
    """Play ``case`` on the twin along SUMO's trace and yield the vehicles that differ, step by step."""
    net = case.world.net
    episode = TwinEpisode(net, twin_traffic(case.traffic, read_road(case.net_path), net), case.step_ms)
    edges = net.lanes["edge"]
    passed: list[list[int]] = [[] for _ in range(len(case.traffic))]
    for t in range(len(sumo.lane)):
        variants = episode.state.vehicles["variant"].copy()
        episode.step()
        found = []
        for v in np.flatnonzero((sumo.lane[t] >= 0) | (episode.state.vehicles["status"] == DRIVING)).tolist():
            theirs = Place(int(sumo.lane[t, v]), float(sumo.position_m[t, v]), float(sumo.speed_mps[t, v]))
            ours = Place(-1, np.nan, np.nan)
            if episode.state.vehicles["status"][v] == DRIVING:
                ours = Place(*episode.state.vehicles[["lane", "position", "speed"]][v].item())
            if theirs.lane >= 0:
                if not passed[v] or edges[passed[v][-1]] != edges[theirs.lane]:
                    passed[v].append(theirs.lane)
                passed[v][-1] = theirs.lane
            off = np.abs(np.subtract(theirs[1:], ours[1:])).max()
            if theirs.lane == ours.lane and off <= TOLERANCE:
                # Rounding errors are removed: they could put an advised speed out of the range of braking.
                if off > ROUNDING:
                    vehicle = episode.state.vehicles[v]
                    vehicle["position"], vehicle["speed"] = theirs[1:]
            else:
                found.append(Difference(t, v, theirs, ours))
        for difference in found:
            _correct(episode, difference, passed[difference.vehicle], sumo)
            v, before = difference.vehicle, sumo.lane[t - 1, difference.vehicle] if t else -1
            if before >= 0 and edges[before] == edges[difference.sumo.lane]:
                episode.state.vehicles["variant"][v] = variants[v]
        yield from found


def _correct(episode: TwinEpisode, difference: Difference, passed: list[int], sumo: Trace) -> None:
    """Move a vehicle to where SUMO has it; ``passed`` are the lanes that its front was on, one for each edge."""
    t, v, theirs, ours = difference
    if theirs.lane < 0:
        later = (sumo.lane[t:, v] >= 0).any()
        status = ARRIVED if passed else WAITING if later else DROPPED
        _remove(*episode.addresses, v, status)
        return
    if episode.state.vehicles["status"][v] == WAITING:
        _leave_queue(*episode.addresses[1:], v)
    state = episode.state
    tails = int(state.vehicles["tail_lanes"][v]) if theirs.lane == ours.lane else -1
    if tails < 0:
        _forget_tail(*episode.addresses[2:], v)
        behind = _lanes_behind(episode, theirs.lane, passed)
        state.tail_lane[v, : len(behind)] = behind
        tails = len(behind)
    _put(*episode.addresses, v, theirs.lane, theirs.position_m, theirs.speed_mps, tails, episode.step_ms)


def _lanes_behind(episode: TwinEpisode, lane: int, passed: list[int]) -> list[int]:
    """Return the lanes that lead to ``lane``, on the edges that were passed, nearest first."""
    net, found = episode.net, []
    edges = net.lanes["edge"]
    for before in reversed(passed[:-1]):
        links = net.incoming_links[net.incoming_start[lane] : net.incoming_start[lane + 1]]
        lanes = [k for k in net.links["from_lane"][links].tolist() if edges[k] == edges[before]]
        if not lanes or len(found) == MAX_TAIL_LANES:
            break
        lane = before if before in lanes else lanes[0]
        found.append(lane)
    return found


@compiled
def _forget_tail(state_at, v):  # type: ignore[no-untyped-def]
    """Remove the tail of ``v`` from all lanes, whatever its own list says."""
    state = open_state(state_at)
    for lane in range(state.tails.shape[0]):
        for j in range(state.lanes[lane].tails):
            if state.tails[lane, j] == v:
                state.lanes[lane].tails -= 1
                state.tails[lane, j] = state.tails[lane, state.lanes[lane].tails]
                break
    state.vehicles[v].tail_lanes = 0


@compiled
def _put(net_at, traffic_at, state_at, v, lane, position, speed, tails, step_ms):  # type: ignore[no-untyped-def]
    """Put ``v`` on ``lane``, with the first ``tails`` lanes of its list behind it, as if it had driven there."""
    net, traffic, state = open_net(net_at), open_traffic(traffic_at), open_state(state_at)
    vehicles = state.vehicles
    before = vehicles[v].lane
    _forget_tail(state_at, v)
    if vehicles[v].status == DRIVING:
        remove_from_lane(state, v)
    else:
        before = lane
        vehicles[v].status = DRIVING
        if vehicles[v].variant < 0:
            vehicles[v].variant = find_variant(net, state, traffic.drivers[v].route)
        state.clock.on_road += 1
    vehicles[v].accel += (speed - vehicles[v].speed) * 1000.0 / step_ms
    vehicles[v].position, vehicles[v].speed = position, speed
    if speed > 0.1:
        vehicles[v].waiting_ms = 0
    insert_into_lane(state, v, lane)
    remember_downstream_occupancy(net, state, state.lane_room_before, v, lane)
    set_tail(net, traffic, state, v, tails)
    entered_ms = state.clock.now_ms - step_ms
    if net.lanes[before].edge == net.lanes[lane].edge:
        if before != lane:
            clear_memories(state, v)
    elif not net.lanes[lane].inside:
        vehicles[v].entered_ms = vehicles[v].junction_ms = vehicles[v].conflict_ms = NEVER_MS
        vehicles[v].variant = find_variant(net, state, traffic.drivers[v].route)
    else:
        waits = False
        for k in range(net.incoming_start[lane], net.incoming_start[lane + 1]):
            waits = waits or net.links[net.incoming_links[k]].cont == 1
        if vehicles[v].entered_ms == NEVER_MS:
            vehicles[v].entered_ms = vehicles[v].junction_ms = entered_ms
        # Before its waiting point a vehicle is not in conflict, even if the twin had it further on.
        vehicles[v].conflict_ms = NEVER_MS if waits else entered_ms
        if net.lanes[before].inside:
            # A vehicle that lost right of way has it again.
            vehicles[v].junction_ms = min(vehicles[v].junction_ms, entered_ms)


@compiled
def _remove(net_at, traffic_at, state_at, v, status):  # type: ignore[no-untyped-def]
    """Remove ``v`` from the road; a waiting vehicle is the next to enter on its lane."""
    traffic, state = open_traffic(traffic_at), open_state(state_at)
    _forget_tail(state_at, v)
    remove_from_lane(state, v)
    state.vehicles[v].status = status
    state.clock.on_road -= 1
    if status == WAITING:
        lane = traffic.drivers[v].depart_lane
        state.waiting_next[v] = state.waiting_first[lane]
        state.waiting_first[lane] = v
        if state.waiting_last[lane] < 0:
            state.waiting_last[lane] = v


@compiled
def _leave_queue(traffic_at, state_at, v):  # type: ignore[no-untyped-def]
    """Remove ``v`` from the vehicles that wait to enter."""
    traffic, state = open_traffic(traffic_at), open_state(state_at)
    lane, before = traffic.drivers[v].depart_lane, -1
    w = state.waiting_first[lane]
    while w >= 0 and w != v:
        before, w = w, state.waiting_next[w]
    if w < 0:
        return
    if before < 0:
        state.waiting_first[lane] = state.waiting_next[v]
    else:
        state.waiting_next[before] = state.waiting_next[v]
    if state.waiting_last[lane] == v:
        state.waiting_last[lane] = before
