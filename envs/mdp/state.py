"""The state of compiled code: an episode's tables, road, clock, rules and frame, reached by one address."""

from __future__ import annotations

from dataclasses import fields
from typing import Annotated, Any, NamedTuple

import numpy as np

from izoo.contexts.context import Context
from izoo.emissions.kernel import KernelWeights
from izoo.envs.config import GLIDE, SCOPES, SPEED, STEP, STOP, EnvConfig
from izoo.envs.mdp.blocked_demand import NEVER, cohort_of, earliest_arrivals, idle_rates
from izoo.envs.mdp.columns import Vehicle
from izoo.envs.mdp.displacement import ROAD
from izoo.envs.mdp.frame import frame_types
from izoo.envs.mdp.metric_sums import EpisodeSums, Sums
from izoo.envs.mdp.observation import neighbour_columns, observed_table
from izoo.envs.mdp.reward import INDIVIDUAL, SHARED, TERMS, RewardConfig
from izoo.envs.mdp.signals import CLOCK, Shown
from izoo.envs.mdp.units import Units, human_units
from izoo.envs.tables import Byte1, Float1, Float2, Int1, Long1, Single2, TablesType, opener, tables_type
from izoo.networks.road import LEAVING, RoadNet
from izoo.traffic.sampling import Traffic

EVERY_STEP, ONCE, ONCE_AND_BEHIND = range(len(SCOPES))
"""Values of ``rules.scope``."""
FREE, FREED = -1, -2
"""Entries of :attr:`Tables.agent_row` without a vehicle: a free slot, and one that was freed in this decision and is
not free before the next."""
NOT_DUE, ENTERED, BLOCKED = range(3)
"""Status of a vehicle of the demand: could not have reached the region yet; has entered it; is blocked outside."""

Cursor = np.dtype(
    [
        *((name, "i8") for name in ("members", "leavers", "wrong_lane_agents", "decision_steps", "due")),
        ("started_s", "f8"),
    ]
)
"""Numbers of members, leavers and wrong-lane agents, steps of the present decision that were played, and vehicles whose
earliest arrival has passed; simulated time at the first frame."""
Demand = np.dtype(
    [
        *((name, "f8") for name in ("length_m", "earliest_s", "idle_gps")),
        *((name, "i4") for name in ("approach", "exit", "moves_class", "status", "arrival_step", "row")),
        *((name, "u1") for name in ("is_cv", "cohort", "early")),
    ],
    align=True,
)
"""A vehicle of the episode: time at which it would reach the region at the speed limit, CO2 rate when idling on its
approach (g/s); whether it is scheduled to depart between warm-up and horizon. These change: status, steps played when
it entered the region (:data:`~izoo.envs.mdp.blocked_demand.NEVER` until then), row in :attr:`Tables.vehicles` (-1:
none), and whether it entered before the first frame."""
Blocked = np.dtype([(name, "f8") for name in ("vehicles", "idle_gps", "step_vehicles", "step_idle_gps")])
"""Of an approach: number of blocked vehicles, their CO2 rate when idling (g/s), and the same as counted in a step."""


class Tables(NamedTuple):
    """What changes in an environment with ``N`` vehicles in the demand, ``A`` agent slots and ``L`` lanes.

    Attributes:
        cursor: a record, :data:`Cursor`.
        vehicles: ``[N + 1]``, a record per vehicle (:mod:`izoo.envs.mdp.columns`); the last is that of a vehicle that
            idles, working memory of the reward.
        terms: ``[N + 1, T]`` individual reward terms; a leaver's are used once more.
        sums: ``[2 * P]``, a record of the metrics of each approach; the second half receives those of the steps after
            the horizon, which are discarded.
        episode: a record of the episode's metrics.
        agent_row: ``[A]`` row behind each agent slot, below 0 where it is empty (:data:`FREE`, :data:`FREED`).
        acting: ``[A]`` rows of the agents that were there when the decision began and still were when the step began;
            -1 for all other slots.
        stage: ``[A]`` 0 has not decided yet, 1 decided before the stop line, 2 behind it.
        decision, deferred: ``[A, D]`` and ``[A]`` the agent's last action, and whether it is left to its driver.
        members: ``[N + 1]`` rows of the vehicles in the region, in order of arrival.
        leavers: ``[N + 1]`` rows whose vehicle left in this step; they hold its last state.
        wrong_lane_agents: ``[N + 1]`` agents' rows on a lane that does not lead to their exit.
        order, lane_start: ``[N + 1]`` and ``[L + 1]``, the members sorted by lane and position.
        demand: ``[N]``, a record per vehicle of the episode, :data:`Demand`. blocked: ``[P]``, :data:`Blocked`.
        signal: ``[P, Q]``, the present state of the signals, :data:`~izoo.envs.mdp.signals.Shown`.
    """

    cursor: Annotated[np.ndarray, Cursor, 0]
    vehicles: Annotated[np.ndarray, Vehicle, 1]
    terms: Float2
    sums: Annotated[np.ndarray, Sums, 1]
    episode: Annotated[np.ndarray, EpisodeSums, 0]
    agent_row: Long1
    acting: Long1
    stage: Byte1
    decision: Single2
    deferred: Byte1
    members: Long1
    leavers: Long1
    wrong_lane_agents: Long1
    order: Long1
    lane_start: Long1
    demand: Annotated[np.ndarray, Demand, 1]
    blocked: Annotated[np.ndarray, Blocked, 1]
    signal: Annotated[np.ndarray, Shown, 2]


def empty_tables(config: EnvConfig, road: RoadNet, demand: np.ndarray) -> Tables:
    """Return tables without vehicles, with room for all of the demand."""
    c, a = len(demand) + 1, config.num_agents
    return Tables(
        cursor=np.zeros((), Cursor),
        vehicles=np.zeros(c, Vehicle),
        terms=np.zeros((c, len(INDIVIDUAL))),
        sums=np.zeros(2 * config.num_approaches, Sums),
        episode=np.zeros((), EpisodeSums),
        agent_row=np.full(a, FREE),
        acting=np.full(a, -1),
        stage=np.zeros(a, np.uint8),
        decision=np.zeros((a, config.action_size), np.float32),
        deferred=np.zeros(a, np.uint8),
        members=np.zeros(c, np.int64),
        leavers=np.zeros(c, np.int64),
        wrong_lane_agents=np.zeros(c, np.int64),
        order=np.zeros(c, np.int64),
        lane_start=np.zeros(len(road.lane_ids) + 1, np.int64),
        demand=demand,
        blocked=np.zeros(len(road.approaches), Blocked),
        signal=np.zeros(road.movement_turn.shape, Shown),
    )


class Work(NamedTuple):
    """Working memory of a step; only ``written`` carries over to the next.

    Attributes:
        command, target_mps, release: ``[A]`` commands for the coming step: rows and their speeds, and rows that are no
            longer commanded.
        capped, cap_mps: ``[A]`` rows with a new maximum speed, and the speeds.
        lane_fill: ``[L]``. rearmost: ``[P]``.
        own: ``[A, T]``. fleet, idling: ``[T]``. shared, own_shared: ``[S]``. step_reward: ``[A]``.
        written: ``[A]`` whether the slot's row of the frame's observation may be non-zero.
    """

    command: Long1
    target_mps: Float1
    release: Long1
    capped: Long1
    cap_mps: Float1
    lane_fill: Long1
    rearmost: Long1
    own: Float2
    fleet: Float1
    idling: Float1
    shared: Float1
    own_shared: Float1
    step_reward: Float1
    written: Byte1


def working_memory(config: EnvConfig, road: RoadNet) -> Work:
    """Return the working memory of an episode."""
    a, individual, shared = config.num_agents, len(INDIVIDUAL), len(SHARED)
    return Work(
        command=np.zeros(a, np.int64),
        target_mps=np.zeros(a),
        release=np.zeros(a, np.int64),
        capped=np.zeros(a, np.int64),
        cap_mps=np.zeros(a),
        lane_fill=np.zeros(len(road.lane_ids), np.int64),
        rearmost=np.zeros(len(road.approaches), np.int64),
        own=np.zeros((a, individual)),
        fleet=np.zeros(individual),
        idling=np.zeros(individual),
        shared=np.zeros(shared),
        own_shared=np.zeros(shared),
        step_reward=np.zeros(a),
        written=np.ones(a, np.uint8),
    )


def demand_records(
    config: EnvConfig, context: Context, road: RoadNet, traffic: Traffic, surrogates: KernelWeights
) -> np.ndarray:
    """Return the records of an episode's traffic."""
    demand = np.zeros(len(traffic), Demand)
    for name in ("length_m", "approach", "exit", "moves_class", "is_cv"):
        demand[name] = getattr(traffic, name)
    demand["cohort"] = cohort_of(config, traffic)
    demand["earliest_s"] = earliest_arrivals(road, traffic)
    demand["idle_gps"] = idle_rates(context, road, traffic, surrogates)
    demand["arrival_step"], demand["row"] = NEVER, -1
    return demand


_NUMBERS = {field.name: getattr(RewardConfig, field.name) for field in fields(RewardConfig) if field.name not in TERMS}
"""Fields of :class:`~izoo.envs.mdp.reward.RewardConfig` other than weights, with their defaults."""
Rules = np.dtype(
    [
        *((name, "f8") for name in ("step_s", "temperature_c", "humidity_pct", "fleet_g_per_step", "sensor_range_m")),
        *(
            (name, "i8")
            for name in (
                *("scope", "hold_steps", "control_steps", "total_steps", "num_vehicles"),
                *("before_column", "behind_column", "stop_column", "glide_column"),
            )
        ),
        *((name, "u1") for name in ("speeds", "electric")),
        *((f"emit_{name}", "u1") for name in ("vector", "vehicles", "signal", "metrics", "number")),
        *((name, "u1" if isinstance(value, bool) else "f8") for name, value in _NUMBERS.items()),
    ],
    align=True,
)
"""Constants of an episode: decisions, weather, engine, unit of the fleet's reward, sensors, emitted groups, and the
numbers of :class:`~izoo.envs.mdp.reward.RewardConfig` on which reward terms may depend."""


def rules_of(config: EnvConfig, context: Context, units: Units) -> np.ndarray:
    """Return the rules of an episode, a record."""
    rules = np.zeros((), Rules)
    values = {
        **{name: getattr(config.reward, name) for name in _NUMBERS},
        "step_s": config.step_s,
        "temperature_c": context.temperature_c,
        "humidity_pct": context.humidity_pct,
        "fleet_g_per_step": units.fleet_g_per_step,
        "sensor_range_m": np.inf if config.sensor_range_m is None else config.sensor_range_m,
        "scope": SCOPES.index(config.decide),
        "hold_steps": config.hold_steps,
        "control_steps": config.control_steps,
        "total_steps": config.total_steps,
        "num_vehicles": config.num_vehicles,
        "before_column": config.column("speed", "speed_before"),
        "behind_column": config.column("speed", "speed_behind"),
        "stop_column": config.column(STOP),
        "glide_column": config.column(GLIDE),
        "speeds": config.action == SPEED,
        "electric": context.engine == "electric",
        "emit_vector": "reward_vector" in config.emit,
        "emit_vehicles": "vehicles" in config.emit,
        "emit_signal": "signal" in config.emit,
        "emit_metrics": "metrics" in config.emit,
        "emit_number": config.decide != STEP or "number" in config.emit,
    }
    for name, value in values.items():
        rules[name] = value
    return rules


def _exit_limits(road: RoadNet) -> np.ndarray:
    """Return the speed limit in m/s of each exit, ``[Q]``."""
    limits = np.zeros(len(road.exits))
    leaving = road.lane_location == LEAVING
    np.maximum.at(limits, road.lane_exit[leaving], road.lane_limit_mps[leaving])
    return limits


TABLES, WORK = tables_type(Tables), tables_type(Work)
FRAME = TablesType("Frame", tuple(frame_types()), constant=False)


class World(NamedTuple):
    """Everything about an episode, as views for compiled code.

    Attributes:
        tables, work, road, clock: :class:`Tables`, :class:`Work`, :class:`~izoo.envs.mdp.displacement.Road`,
            :class:`~izoo.envs.mdp.signals.Clock`.
        frame: the arrays of one environment's frame, by name (:mod:`izoo.envs.mdp.frame`).
        rules: a record, :data:`Rules`.
        weights, shared_weights: ``[T]`` and ``[S]`` of the reward's terms.
        unit_g: ``[P]`` CO2 of a human-driven vehicle of each approach.
        exit_limit_mps: ``[Q]``.
        neighbour_columns: ``[6]`` from :func:`~izoo.envs.mdp.observation.neighbour_columns`.
        features: ``[P * Q, O]`` observed context features of each movement, scaled.
        by_earliest: ``[N]`` the demand in the order of its earliest arrivals.
        entry_lanes: int32, the simulator's lanes on which vehicles are first seen in the region, for a simulator in
            compiled code.
    """

    tables: Annotated[Any, TABLES]
    work: Annotated[Any, WORK]
    frame: Annotated[Any, FRAME]
    road: Annotated[Any, ROAD]
    clock: Annotated[Any, CLOCK]
    rules: Annotated[np.ndarray, Rules, 0]
    weights: Float1
    shared_weights: Float1
    unit_g: Float1
    exit_limit_mps: Float1
    neighbour_columns: Long1
    features: Float2
    by_earliest: Long1
    entry_lanes: Int1


WORLD = tables_type(World)
open_world = opener(WORLD)
"""``open_world(address)``: the :class:`World` of a directory, in compiled code."""


def constants_of(
    config: EnvConfig, context: Context, road: RoadNet, traffic: Traffic, surrogates: KernelWeights
) -> dict[str, np.ndarray]:
    """Return those arrays of a :class:`World` which do not change in the course of an episode, by name."""
    units = Units(np.ones(1), 1.0)
    if config.reward.sums:
        units = human_units(context, road, traffic, surrogates, config.horizon_s, config.step_s)
    features = observed_table(context, road, config.observed)
    return {
        "rules": rules_of(config, context, units),
        "weights": np.array([getattr(config.reward, option) for option in INDIVIDUAL], float),
        "shared_weights": np.array([getattr(config.reward, option) for option in SHARED], float),
        "unit_g": units.unit_g,
        "exit_limit_mps": _exit_limits(road),
        "neighbour_columns": neighbour_columns(config.neighbours),
        "features": np.ascontiguousarray(features.reshape(road.movement_turn.size, features.shape[-1])),
        "by_earliest": np.argsort(earliest_arrivals(road, traffic), kind="stable"),
    }
