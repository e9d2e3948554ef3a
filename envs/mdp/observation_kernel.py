"""Observations in compiled code: the columns of :mod:`izoo.envs.mdp.observation` for every agent slot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from izoo.compiling import compiled, line_writer
from izoo.envs.mdp.neighbours import find_follower, find_leader, first_at_or_beyond
from izoo.envs.mdp.observation import EGO_COLUMNS, FAR_M, NEIGHBOUR_COLUMNS, Column

NUM_SEEN = len(NEIGHBOUR_COLUMNS)


def _writer(columns: Sequence[Column], arguments: str) -> Any:
    return line_writer([column.value for column in columns], [column.scale for column in columns], arguments)


_write_ego = _writer(EGO_COLUMNS, "vehicle, road, clock")
_write_neighbour = _writer(NEIGHBOUR_COLUMNS, "other, present, gap_m, lane_exists")


@compiled(borrows=True)
def write_observations(agent_row, written, tables, road, clock, sensors, out):  # type: ignore[no-untyped-def]
    """Write the observation ``out [A, F]`` of every agent slot; empty slots (row -1) become zero.

    Args:
        agent_row: ``[A]`` rows of ``tables.vehicles``.
        written: ``[A]`` whether a slot's line may be non-zero; lines that are zero are not cleared again.
        road, clock: arrays of the road, and the state of the signals.
        sensors: ``features [P, Q, O]``, observed context features of each movement, scaled; ``columns [6]`` from
            :func:`~izoo.envs.mdp.observation.neighbour_columns`; ``sensor_range_m``, beyond which vehicles count as
            absent.
    """
    features, columns = sensors.features, sensors.columns
    first_feature = out.shape[1] - features.shape[2]
    for a in range(agent_row.shape[0]):
        r = agent_row[a]
        if r < 0 and not written[a]:
            continue
        line = out[a]
        line[:] = 0.0
        written[a] = r >= 0
        if r < 0:
            continue
        vehicle = tables.vehicles[r]
        _write_ego(vehicle, road, clock, line)
        p, q = vehicle.approach, vehicle.exit
        for side in range(3):
            if columns[2 * side] >= 0 or columns[2 * side + 1] >= 0:
                _write_neighbours(side, r, tables, road, sensors, line)
        for j in range(features.shape[2]):
            line[first_feature + j] = features[p, q, j]


@compiled(borrows=True, forceinline=True)
def _write_neighbours(side, r, tables, road, sensors, line):  # type: ignore[no-untyped-def]
    """Write leader and follower of vehicle ``r`` on a side (0 its own lane, 1 left, 2 right)."""
    vehicles, columns = tables.vehicles, sensors.columns
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
        if other < 0 or gap > sensors.sensor_range_m:
            other, gap = -1, FAR_M
        seen = line[column : column + NUM_SEEN]
        _write_neighbour(vehicles[max(other, 0)], other >= 0, gap, lane >= 0, seen)


@compiled(borrows=True, forceinline=True)
def _neighbour_lane(side, r, tables, road):  # type: ignore[no-untyped-def]
    """Return the lane on a side of vehicle ``r`` (0 its own, 1 left, 2 right), the position of ``r`` on it, and the
    index in ``order`` of the first vehicle ahead."""
    lane, position = tables.vehicles[r].region_lane, tables.vehicles[r].lane_position_m
    if side == 0:
        return lane, position, tables.vehicles[r].place + 1
    seen_lane = road.lane_left[lane] if side == 1 else road.lane_right[lane]
    if seen_lane < 0:
        return seen_lane, position, 0
    # Lanes of one edge end together, so positions on them compare from the end.
    position += road.lane_length[seen_lane] - road.lane_length[lane]
    return seen_lane, position, first_at_or_beyond(seen_lane, position, tables)
