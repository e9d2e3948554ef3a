"""Memory of the environments that come next, asked for while one is played.

A step touches some sixty kilobytes, and the tables of a hundred environments do not stay in the cache. Read one after
the other, as the step needs them, its lines come at the pace of the memory's latency; asked for ahead they are there.
A few lines are asked for with each vehicle that is driven.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils, errors

from izoo.compiling import intrinsic
from izoo.envs.mdp import columns
from izoo.envs.mdp.displacement import ROAD
from izoo.envs.mdp.reward_kernel import NUM_TERMS
from izoo.envs.mdp.signals import CLOCK
from izoo.envs.mdp.state import FRAME, TABLES, WORK, WORLD, open_world
from izoo.envs.tables import LINE_BYTES, WORDS, compiled, place_of
from izoo.envs.twin.runtime.layout import STATE, TRAFFIC, Driver, Vehicle, open_state, open_traffic

WORLD_AT, NET_AT, TRAFFIC_AT, STATE_AT = range(4)
"""Columns of the addresses of directories, ``[N, ADDRESSES]``."""
ADDRESSES = 4
_WORD_BYTES = 8
_WORLD_BYTES, _STATE_BYTES, _TRAFFIC_BYTES = (
    sum(len(kind.fields) for kind in kinds) * WORDS * _WORD_BYTES
    for kinds in ((WORLD, TABLES, WORK, FRAME, ROAD, CLOCK), (STATE,), (TRAFFIC,))
)
_VEHICLE_BYTES, _DRIVER_BYTES, _MEMBER_BYTES = Vehicle.itemsize, Driver.itemsize, columns.Vehicle.itemsize
_STRAGGLERS = 8
"""For so many vehicles that are where they are expected, one more is asked for."""


RANGES = 24
"""Rows of a list of ranges, ``[RANGES, 2]`` int64 with begin and end in each; the last row holds how many of them are
done and how many there are, the one before it how many lines they have."""
_DONE, LINES = RANGES - 1, RANGES - 2


def no_ranges() -> np.ndarray:
    """Return an empty list of ranges."""
    return np.zeros((RANGES, 2), np.int64)


@intrinsic
def fetch_line(typing_context, address):  # type: ignore[no-untyped-def]
    """Ask for the line of the cache at ``address``, which nothing waits for."""
    if not isinstance(address, types.Integer):
        raise errors.NumbaTypeError("an address is an integer")

    def lower(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        asking = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        call = cgutils.get_or_insert_function(builder.module, asking, "llvm.prefetch.p0")
        # To be read, kept in the second level, data.
        builder.call(call, [builder.inttoptr(args[0], byte), number(0), number(2), number(1)])
        return context.get_dummy_value()

    return types.none(types.int64), lower


@compiled
def fetch(address, size):  # type: ignore[no-untyped-def]
    """Ask for ``size`` bytes from ``address`` on."""
    for at in range(0, size, LINE_BYTES):
        fetch_line(address + at)


@compiled
def list_next(addresses, k, drives, ranges):  # type: ignore[no-untyped-def]
    """List what the environment after number ``k`` will need, and ask for where that of the one behind it is.

    Args:
        addresses: ``[n, ADDRESSES]``.
        k: the environment that is about to be played.
        drives: whether vehicles will be driven.
        ranges: output, for :func:`fetch_some`.
    """
    count = addresses.shape[0]
    ranges[_DONE, 0] = ranges[_DONE, 1] = ranges[LINES, 0] = 0
    if k == 0 and count > 1:
        _fetch_directories(addresses, 1)
    if k + 2 < count:
        _fetch_directories(addresses, k + 2)
    if k + 1 < count:
        if drives:
            _list_driving(addresses, k + 1, ranges)
        _list_world(open_world(addresses[k + 1, WORLD_AT]), ranges)


@compiled
def lines_for_each(ranges, count):  # type: ignore[no-untyped-def]
    """Return how many lines to ask for at a time, to have all of them after ``count`` times."""
    return ranges[LINES, 0] // max(1, count) + 1


@compiled
def fetch_some(ranges, lines):  # type: ignore[no-untyped-def]
    """Ask for the next ``lines`` of what is listed.

    The processor has room for some dozens of requests and stands still when there are more, so they are best made
    between other work.
    """
    k = ranges[_DONE, 0]
    while lines > 0 and k < ranges[_DONE, 1]:
        at, end = ranges[k, 0], ranges[k, 1]
        while lines > 0 and at < end:
            fetch_line(at)
            at += LINE_BYTES
            lines -= 1
        ranges[k, 0] = at
        if at >= end:
            k += 1
    ranges[_DONE, 0] = k


@compiled
def _list(ranges, address, size):  # type: ignore[no-untyped-def]
    k = ranges[_DONE, 1]
    ranges[k, 0], ranges[k, 1] = address, address + size
    ranges[_DONE, 1] = k + 1
    ranges[LINES, 0] += (size + LINE_BYTES - 1) // LINE_BYTES


@compiled
def _fetch_directories(addresses, k):  # type: ignore[no-untyped-def]
    fetch(addresses[k, WORLD_AT], _WORLD_BYTES)
    fetch(addresses[k, STATE_AT], _STATE_BYTES)
    fetch(addresses[k, TRAFFIC_AT], _TRAFFIC_BYTES)


@compiled
def _list_driving(addresses, k, ranges):  # type: ignore[no-untyped-def]
    """List lanes, signals, and the vehicles on the road: mostly those that departed last."""
    state, traffic = open_state(addresses[k, STATE_AT]), open_traffic(addresses[k, TRAFFIC_AT])
    # These lie in one piece, in the order of state_shapes.
    _list(ranges, place_of(state.clock), place_of(state.vehicles) - place_of(state.clock))
    on_road = state.clock.on_road + state.clock.on_road // _STRAGGLERS
    first = max(0, state.clock.next_departure - on_road)
    count = state.clock.next_departure - first
    for place, row_bytes in (
        (place_of(state.vehicles), _VEHICLE_BYTES),
        (place_of(traffic.drivers), _DRIVER_BYTES),
    ):
        _list(ranges, place + first * row_bytes, count * row_bytes)


@compiled
def _list_world(world, ranges):  # type: ignore[no-untyped-def]
    """List the tables' rows that are taken, mostly the first ones, and what there is of every agent slot."""
    tables, frame = world.tables, world.frame
    rows = min(tables.cursor.members + tables.cursor.members // _STRAGGLERS, tables.vehicles.shape[0])
    _list(ranges, place_of(tables.vehicles), rows * _MEMBER_BYTES)
    _list(ranges, place_of(tables.terms), rows * NUM_TERMS * _WORD_BYTES)
    _list(ranges, place_of(tables.members), rows * _WORD_BYTES)
    _list(ranges, place_of(tables.order), rows * _WORD_BYTES)
    _list(ranges, place_of(tables.lane_start), tables.lane_start.shape[0] * _WORD_BYTES)
    slots = tables.agent_row.shape[0]
    _list(ranges, place_of(tables.agent_row), slots * _WORD_BYTES)
    _list(ranges, place_of(tables.acting), slots * _WORD_BYTES)
    _list(ranges, place_of(frame.agent_vehicle), slots * _WORD_BYTES)
    _list(ranges, place_of(frame.action), slots * frame.action.shape[1] * _WORD_BYTES // 2)
    _list(ranges, place_of(frame.reward), slots * _WORD_BYTES // 2)
    _list(ranges, place_of(frame.defer), slots)
    _list(ranges, place_of(frame.mask), slots)
    _list(ranges, place_of(frame.agent_terminated), slots)
    _list(ranges, place_of(frame.agent_done), slots)
