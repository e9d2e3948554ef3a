"""What compiled code works on: one episode's tables, road, clock, rules, surrogates and frame, as one value."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.core import types
from numba.experimental import structref

from izoo.compiling import compiled
from izoo.contexts.context import Context
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.observation import NEIGHBOURS, observed_table
from izoo.envs.mdp.pay import NUM_TERMS, Numbers, reward_arrays
from izoo.envs.mdp.state import FLAGS, FLOATS, INTS
from izoo.metrics.definitions import APPROACH_METRICS, EPISODE_METRICS
from izoo.networks.road import RoadNet
from izoo.traffic.sampling import Traffic

MIN_CAPACITY = 256
(MEMBERS, LEAVERS, SUSPECTS, PHASE) = range(4)
"""Entries of :attr:`Tables.cursor`: how many members, leavers and suspects there are, and the phase of the signal."""


class Tables(NamedTuple):
    """The tables of one environment, with room for ``C`` vehicles and ``A`` agents on ``L`` lanes.

    Attributes:
        floats, ints, flags: ``[C, *]``, a row per vehicle (:mod:`izoo.envs.mdp.state`).
        terms: ``[C, T]`` individual reward terms; a leaver's are needed once more.
        sums, episode: ``[P, M]`` and ``[E]`` metrics.
        agent_row: ``[A]`` row behind each agent slot, -1 where it is empty.
        acting: ``[A]`` the same when the step began: who acted in it.
        members: ``[C]`` rows of the vehicles in the region, in the order in which they came.
        leavers: ``[C]`` rows whose vehicle left in this step; they still hold its last state.
        suspects: ``[C]`` agents' rows on a lane that does not lead to their exit.
        order, lane_start: ``[C]`` and ``[L + 1]``, the members sorted by lane and position.
        command, target_mps, release: ``[A]`` orders for the coming step: rows with their speeds, and rows that are no
            longer commanded.
        cursor: ``[4]`` how far the lists above are filled, and the signal's phase.
    """

    floats: np.ndarray
    ints: np.ndarray
    flags: np.ndarray
    terms: np.ndarray
    sums: np.ndarray
    episode: np.ndarray
    agent_row: np.ndarray
    acting: np.ndarray
    members: np.ndarray
    leavers: np.ndarray
    suspects: np.ndarray
    order: np.ndarray
    lane_start: np.ndarray
    command: np.ndarray
    target_mps: np.ndarray
    release: np.ndarray
    cursor: np.ndarray


PER_ROW = ("floats", "ints", "flags", "terms", "members", "leavers", "suspects", "order")
"""Tables with an entry per row."""


def empty_tables(config: EnvConfig, num_lanes: int) -> Tables:
    """Return tables without vehicles."""
    c, a = max(MIN_CAPACITY, config.num_vehicles), config.num_agents
    return Tables(
        floats=np.zeros((c, len(FLOATS))),
        ints=np.zeros((c, len(INTS)), np.int64),
        flags=np.zeros((c, len(FLAGS)), np.uint8),
        terms=np.zeros((c, NUM_TERMS)),
        sums=np.zeros((config.num_approaches, len(APPROACH_METRICS))),
        episode=np.zeros(len(EPISODE_METRICS)),
        agent_row=np.full(a, -1),
        acting=np.full(a, -1),
        members=np.zeros(c, np.int64),
        leavers=np.zeros(c, np.int64),
        suspects=np.zeros(c, np.int64),
        order=np.zeros(c, np.int64),
        lane_start=np.zeros(num_lanes + 1, np.int64),
        command=np.zeros(a, np.int64),
        target_mps=np.zeros(a),
        release=np.zeros(a, np.int64),
        cursor=np.zeros(4, np.int64),
    )


def grown(tables: Tables) -> Tables:
    """Return tables with twice the rows, and all that was in them."""
    longer = {name: np.concatenate([old := getattr(tables, name), np.zeros_like(old)]) for name in PER_ROW}
    return tables._replace(**longer)


class Demand(NamedTuple):
    """What is known of every vehicle of the episode beforehand, ``[N]`` each."""

    is_cv: np.ndarray
    approach: np.ndarray
    exit: np.ndarray
    length_m: np.ndarray
    moves_class: np.ndarray


def demand_arrays(traffic: Traffic) -> Demand:
    """Pick the arrays out of an episode's traffic."""
    return Demand(*(np.ascontiguousarray(getattr(traffic, name)) for name in Demand._fields))


class Rules(NamedTuple):
    """What stays fixed for an episode: weather, engine, reward, sensors, and what is emitted."""

    step_s: float
    temperature_c: float
    humidity_pct: float
    electric: bool
    reward: Numbers
    weights: np.ndarray
    shared_weights: np.ndarray
    sensor_range_m: float
    neighbours: np.ndarray
    features: np.ndarray
    num_vehicles: int
    emit_vehicles: bool
    emit_signal: bool
    emit_metrics: bool


def rules_of(config: EnvConfig, context: Context, road: RoadNet) -> Rules:
    """Return the rules of an episode."""
    reward, weights, shared_weights = reward_arrays(config.reward)
    return Rules(
        step_s=config.step_s,
        temperature_c=context.temperature_c,
        humidity_pct=context.humidity_pct,
        electric=context.engine == "electric",
        reward=reward,
        weights=weights,
        shared_weights=shared_weights,
        sensor_range_m=np.inf if config.sensor_range_m is None else float(config.sensor_range_m),
        neighbours=np.array([NEIGHBOURS.index(name) for name in config.neighbours], np.int64),
        features=observed_table(context, road, config.observed),
        num_vehicles=config.num_vehicles,
        emit_vehicles="vehicles" in config.emit,
        emit_signal="signal" in config.emit,
        emit_metrics="metrics" in config.emit,
    )


class Frame(NamedTuple):
    """The frame's arrays that compiled code reads or writes in every step (:mod:`izoo.envs.mdp.frame`)."""

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
    """Everything about an episode, as views for compiled code; nothing is copied.

    Handing this over instead of some ninety arrays saves a fraction of a microsecond for each of them, in every step.
    """


structref.define_proxy(World, WorldType, ["tables", "demand", "road", "clock", "rules", "surrogate", "frame"])


@compiled
def hold(tables, demand, road, clock, rules, surrogate, frame):  # type: ignore[no-untyped-def]
    """Return a :class:`World`."""
    return World(tables, demand, road, clock, rules, surrogate, frame)
