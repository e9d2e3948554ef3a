"""Observations in compiled code: the columns of :mod:`izoo.envs.mdp.observation` for every agent slot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from izoo.compiling import line_writer
from izoo.envs.mdp.neighbours import find_follower, find_leader, first_at_or_beyond
from izoo.envs.mdp.observation import EGO_COLUMNS, FAR_M, NEIGHBOUR_COLUMNS, Column
from izoo.envs.tables import compiled


def _writer(columns: Sequence[Column], arguments: str) -> Any:
    return line_writer([column.value for column in columns], [column.scale for column in columns], arguments)


_write_ego = _writer(EGO_COLUMNS, "vehicle, road, signal")
_write_neighbour = _writer(NEIGHBOUR_COLUMNS, "other, present, gap_m, lane_exists")


@compiled
def write_observations(world):  # type: ignore[no-untyped-def]
    """Write the observation of every agent slot to the frame; that of an empty slot becomes zero."""
    tables, features, columns, out = world.tables, world.features, world.neighbour_columns, world.frame.observation
    written = world.work.written
    first_feature = out.shape[1] - features.shape[1]
    for a in range(tables.agent_row.shape[0]):
        r = tables.agent_row[a]
        if r < 0 and not written[a]:  # it is zero already
            continue
        line = out[a]
        for c in range(line.shape[0]):
            line[c] = 0.0
        written[a] = r >= 0
        if r < 0:
            continue
        vehicle = tables.vehicles[r]
        p, q = vehicle.approach, vehicle.exit
        _write_ego(vehicle, world.road, tables.signal[p, q], line, 0)
        for side in range(3):
            if columns[2 * side] >= 0 or columns[2 * side + 1] >= 0:
                _write_neighbours(side, r, world, line)
        for j in range(features.shape[1]):
            line[first_feature + j] = features[p * tables.signal.shape[1] + q, j]


@compiled(forceinline=True)
def _write_neighbours(side, r, world, line):  # type: ignore[no-untyped-def]
    """Write leader and follower of vehicle ``r`` on a side (0 its own lane, 1 left, 2 right)."""
    tables, road, columns = world.tables, world.road, world.neighbour_columns
    vehicles = tables.vehicles
    lane, position, ahead = _neighbour_lane(side, r, tables, road)
    for back in range(2):
        column = columns[2 * side + back]
        if column < 0:
            continue
        other, gap = -1, FAR_M
        if lane >= 0 and back == 0:
            other, gap = find_leader(lane, position, ahead, vehicles[r].exit, r, tables, road)
        elif lane >= 0:
            last = ahead - 2 if side == 0 else ahead - 1
            approach = vehicles[r].approach
            other, gap = find_follower(lane, position, last, vehicles[r].length_m, approach, r, tables, road)
        if other < 0 or gap > world.rules.sensor_range_m:
            other, gap = -1, FAR_M
        _write_neighbour(vehicles[max(other, 0)], other >= 0, gap, lane >= 0, line, column)


@compiled(forceinline=True)
def _neighbour_lane(side, r, tables, road):  # type: ignore[no-untyped-def]
    """Return the lane on a side of vehicle ``r`` (0 its own, 1 left, 2 right), the position of ``r`` on it, and the
    index in ``order`` of the first vehicle ahead."""
    lane, position = tables.vehicles[r].region_lane, tables.vehicles[r].lane_position_m
    if side == 0:
        return lane, position, tables.vehicles[r].place + 1
    seen_lane = road.lanes[lane].left if side == 1 else road.lanes[lane].right
    if seen_lane < 0:
        return seen_lane, position, 0
    # Lanes of one edge end together, so positions on them compare from the end.
    position += road.lanes[seen_lane].length_m - road.lanes[lane].length_m
    return seen_lane, position, first_at_or_beyond(seen_lane, position, tables)
