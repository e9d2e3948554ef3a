"""One compiled call per step: everything between reading SUMO and handing out a frame.

Calling compiled code costs a fraction of a microsecond per array that is passed, and there are some seventy, so the
kernels of :mod:`izoo.envs.kernels` and :mod:`izoo.envs.accounting` are joined here, and what lives as long as an
episode is handed over once, in a :class:`World`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numba.core import types
from numba.experimental import structref

from izoo.emissions.kernel import emission_rate_kernel
from izoo.envs.accounting import account, pay, plan_commands, reward_terms, sum_episode
from izoo.envs.kernel_cache import forget_stale_kernels
from izoo.envs.kernels import (
    agent_vehicles,
    emit_vehicles,
    find_leaders,
    observe,
    place,
    read_clock,
    sort_lanes,
)
from izoo.envs.layout import (
    ACCEL,
    AGENT,
    ELECTRIC,
    EMISSION,
    GRADE,
    MOVES_CLASS,
    PRESENT,
    SPEED,
    STEADY,
    WRONG_LANE,
)

forget_stale_kernels()


class Tables(NamedTuple):
    """The simulator's tables (columns in :mod:`izoo.envs.layout`) and the working memory of the sort.

    ``floats [C, *]``, ``ints [C, *]``, ``flags [C, *]``, ``terms [C, 5]`` (individual reward terms), ``sums [P, M]``
    and ``episode [E]`` (metrics), ``agent_row [A]`` (-1: empty), ``order [C]``, ``lane_start [L + 1]``, ``suspects
    [C]`` (agents' rows on a lane that does not lead to their exit), ``yields [C]`` (rows that SUMO slows for a lane
    change), and the orders of the coming step: ``command [A]`` and ``release [A]`` (rows), ``target_mps [A]``.
    """

    floats: np.ndarray
    ints: np.ndarray
    flags: np.ndarray
    terms: np.ndarray
    sums: np.ndarray
    episode: np.ndarray
    agent_row: np.ndarray
    order: np.ndarray
    lane_start: np.ndarray
    suspects: np.ndarray
    yields: np.ndarray
    command: np.ndarray
    release: np.ndarray
    target_mps: np.ndarray


class ClockArrays(NamedTuple):
    """Tables of :class:`~izoo.networks.clock.SignalClock`, and the clock's present state ``[P, Q]``."""

    cycle_s: float
    offset_s: float
    phase_begin_s: np.ndarray
    colour: np.ndarray
    legal_on_red: np.ndarray
    change_s: np.ndarray
    second_green_s: np.ndarray
    third_green_s: np.ndarray
    now: np.ndarray
    time_left_s: np.ndarray
    until_second_s: np.ndarray
    until_third_s: np.ndarray


class Rules(NamedTuple):
    """What stays fixed for an episode: weather, reward, sensors, and what is emitted."""

    step_s: float
    temperature_c: float
    humidity_pct: float
    tau_mps: float
    soft_stop: bool
    weights: np.ndarray
    eta: float
    safety: float
    scale: float
    sensor_range_m: float
    neighbours: np.ndarray
    features: np.ndarray
    emit_vehicles: bool
    emit_signal: bool
    emit_metrics: bool


class Frame(NamedTuple):
    """The frame's arrays that compiled code reads or writes in every step."""

    action: np.ndarray
    defer: np.ndarray
    observation: np.ndarray
    mask: np.ndarray
    agent_vehicle: np.ndarray
    agent_terminated: np.ndarray
    agent_done: np.ndarray
    reward: np.ndarray
    reward_vector: np.ndarray
    vehicle_floats: np.ndarray
    vehicle_ints: np.ndarray
    vehicle_flags: np.ndarray
    signal_colour: np.ndarray
    signal_time_left_s: np.ndarray
    approach_metrics: np.ndarray
    episode_metrics: np.ndarray


@structref.register
class WorldType(types.StructRef):  # type: ignore[misc]
    """Type of :class:`World` in compiled code."""


class World(structref.StructRefProxy):  # type: ignore[misc]
    """An episode's tables, road, clock, rules, surrogates and frame, as compiled code holds them; a copy of none."""


structref.define_proxy(World, WorldType, ["tables", "road", "clock", "rules", "surrogate", "frame"])


@njit(cache=True)
def hold(tables, road, clock, rules, surrogate, frame):  # type: ignore[no-untyped-def]
    """Return a :class:`World`."""
    return World(tables, road, clock, rules, surrogate, frame)


@njit(cache=True)
def command_agents(world):  # type: ignore[no-untyped-def]
    """Turn the frame's actions into the orders of the coming step; return how many commands and releases there are."""
    tables, frame = world.tables, world.frame
    return plan_commands(
        tables.agent_row,
        frame.action,
        frame.defer,
        tables.yields,
        world.rules.step_s,
        tables.floats,
        tables.ints,
        tables.flags,
        tables.sums,
        tables.command,
        tables.release,
        tables.target_mps,
    )


@njit(cache=True)
def emit_co2(rows, tables, rules, surrogate):  # type: ignore[no-untyped-def]
    """Write each vehicle's CO2 of the step in g; electric CVs emit nothing."""
    changed = np.empty(rows.shape[0], np.int64)
    n = 0
    for r in rows:
        if not tables.flags[r, STEADY]:
            changed[n] = r
            n += 1
    inputs = np.empty((3, n), np.float32)
    classes = np.empty(n, np.int64)
    active = np.empty(n, np.uint8)
    rate = np.empty(n, np.float32)
    for j in range(n):
        r = changed[j]
        inputs[0, j] = tables.floats[r, SPEED]
        inputs[1, j] = tables.floats[r, ACCEL]
        inputs[2, j] = tables.floats[r, GRADE]
        classes[j] = tables.ints[r, MOVES_CLASS]
        active[j] = tables.flags[r, ELECTRIC] == 0
    emission_rate_kernel(
        inputs[0], inputs[1], inputs[2], classes, active, rules.temperature_c, rules.humidity_pct, surrogate, rate
    )
    for j in range(n):
        tables.floats[changed[j], EMISSION] = rate[j] * rules.step_s


@njit(cache=True)
def copy_into(target, source):  # type: ignore[no-untyped-def]
    """Copy a table to the upper left corner of one that is no smaller.

    A slice assignment would compile the text of an error message that never comes: 2 s each.
    """
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@njit(cache=True)
def make_frame(rows, reading, acting, leavers, time_s, phase, measured, world):  # type: ignore[no-untyped-def]
    """Turn what SUMO reported into the next frame.

    Args:
        rows: ``[n]`` rows of the vehicles in the region.
        reading: tuple of ``[n]`` arrays: region lane, lane position in m, speed in m/s, signal bits.
        acting: ``[A]`` row behind every slot that acted in this step, -1 elsewhere.
        leavers: rows whose vehicle has left; they still hold its last state, and lose their agent slot here.
        time_s: simulated time after the step.
        phase: the signal phase in force during the step.
        measured: whether the step counts (the first frame of an episode does not).
        world: the :class:`World`.

    Returns:
        The phase in force from now on, and the number of suspects.
    """
    tables, road, clock, rules, out = world.tables, world.road, world.clock, world.rules, world.frame
    floats, ints, flags = tables.floats, tables.ints, tables.flags
    lane, position, speed, signals = reading
    place(rows, lane, position, speed, signals, floats, ints, flags, road, rules.step_s)
    sort_lanes(rows, floats, ints, tables.lane_start.shape[0] - 1, tables.order, tables.lane_start)
    find_leaders(rows, floats, ints, flags, tables.order, tables.lane_start, road)
    emit_co2(rows, tables, rules, world.surrogate)
    if measured:
        before, legal = clock.colour[:, :, phase], clock.legal_on_red[:, :, phase]
        account(rows, floats, ints, flags, before, legal, rules.step_s, tables.sums)
    phase = read_clock(
        time_s,
        clock.cycle_s,
        clock.offset_s,
        clock.phase_begin_s,
        clock.colour,
        clock.change_s,
        clock.second_green_s,
        clock.third_green_s,
        clock.now,
        clock.time_left_s,
        clock.until_second_s,
        clock.until_third_s,
    )
    fleet = np.empty(5)
    shortest = reward_terms(rows, floats, rules.tau_mps, rules.soft_stop, tables.terms, fleet)
    pay(
        acting,
        tables.terms,
        fleet,
        shortest,
        rules.weights,
        rules.eta,
        rules.safety,
        rules.scale,
        out.reward,
        out.reward_vector,
        rows.shape[0] == 0,
    )
    out.agent_terminated[:] = 0
    out.agent_done[:] = 0
    for j in range(leavers.shape[0]):
        flags[leavers[j], PRESENT] = 0
        slot = ints[leavers[j], AGENT]
        if slot >= 0:
            tables.agent_row[slot] = -1
            out.agent_terminated[slot] = 1
            out.agent_done[slot] = 1
    state = (clock.now, clock.time_left_s, clock.until_second_s, clock.until_third_s)
    observe(
        tables.agent_row,
        floats,
        ints,
        flags,
        tables.order,
        tables.lane_start,
        road,
        state,
        rules.features,
        rules.neighbours,
        rules.sensor_range_m,
        out.observation,
    )
    agent_vehicles(tables.agent_row, out.mask, out.agent_vehicle)
    if rules.emit_vehicles:
        emit_vehicles(floats, ints, flags, out.vehicle_floats, out.vehicle_ints, out.vehicle_flags)
    if rules.emit_signal:
        copy_into(out.signal_colour, clock.now)
        copy_into(out.signal_time_left_s, clock.time_left_s)
    if measured:
        sum_episode(rows, acting, floats, ints, flags, out.reward, rules.step_s, tables.sums, tables.episode)
    for k in range(tables.episode.shape[0]):
        out.episode_metrics[k] = tables.episode[k]
    if rules.emit_metrics:
        copy_into(out.approach_metrics, tables.sums)
    count = 0
    for j in range(rows.shape[0]):
        r = rows[j]
        if flags[r, WRONG_LANE] and ints[r, AGENT] >= 0:
            tables.suspects[count] = r
            count += 1
    return phase, count
