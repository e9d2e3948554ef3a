"""The state of compiled code: an episode's tables, road, clock, rules, surrogates and frame, as one value."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel import default_manager, models
from numba.core.imputils import impl_ret_borrowed
from numba.core.typing.templates import AttributeTemplate
from numba.experimental import structref
from numba.extending import infer_getattr, lower_getattr_generic, lower_setattr_generic

from izoo.compiling import compiled
from izoo.contexts.context import Context
from izoo.emissions.kernel import KernelWeights
from izoo.envs.config import SCOPES, SPEED, STEP, EnvConfig
from izoo.envs.mdp.blocked_demand import NEVER, cohort_of, earliest_arrivals, idle_rates
from izoo.envs.mdp.columns import Vehicle
from izoo.envs.mdp.metric_sums import APPROACH_METRICS, EPISODE_METRICS
from izoo.envs.mdp.observation import neighbour_columns, observed_table
from izoo.envs.mdp.reward_kernel import NUM_SHARED, NUM_TERMS, Numbers, reward_arrays
from izoo.envs.mdp.units import Units, human_units
from izoo.networks.road import LEAVING, RoadNet
from izoo.traffic.sampling import Traffic

MIN_CAPACITY = 256
_STEPS = EPISODE_METRICS.index("steps")
_DATA_WORD = 3
"""Word of numba's block of managed memory (``MemInfo``) that holds the address of the data."""
(MEMBERS, LEAVERS, WRONG_LANE_AGENTS, DECISION_STEPS, DUE) = range(5)
"""Entries of :attr:`Tables.cursor`: numbers of members, leavers and wrong-lane agents, steps of the present decision
that were played, and vehicles whose earliest arrival has passed."""
EVERY_STEP, ONCE, ONCE_AND_BEHIND = range(len(SCOPES))
"""Values of :attr:`Rules.scope`."""
FREE, FREED = -1, -2
"""Entries of :attr:`Tables.agent_row` without a vehicle: a free slot, and one that was freed in this decision and is
not free before the next."""


class Tables(NamedTuple):
    """The tables of one environment, with room for ``C`` vehicles and ``A`` agents on ``L`` lanes.

    Attributes:
        vehicles: ``[C]``, a record per vehicle (:mod:`izoo.envs.mdp.columns`).
        terms: ``[C, T]`` individual reward terms; a leaver's are used once more.
        sums, episode: ``[P, M]`` and ``[E]`` metrics.
        agent_row: ``[A]`` row behind each agent slot, below 0 where it is empty (:data:`FREE`, :data:`FREED`).
        acting: ``[A]`` rows of the agents that were there when the decision began and still were when the step began;
            -1 for all other slots.
        members: ``[C]`` rows of the vehicles in the region, in order of arrival.
        leavers: ``[C]`` rows whose vehicle left in this step; they hold its last state.
        wrong_lane_agents: ``[C]`` agents' rows on a lane that does not lead to their exit.
        order, lane_start: ``[C]`` and ``[L + 1]``, the members sorted by lane and position.
        command, target_mps, release: ``[A]`` commands for the coming step: rows and their speeds, and rows that are no
            longer commanded.
        capped, cap_mps: ``[A]`` rows with a new maximum speed, and the speeds.
        decision, deferred: ``[A, D]`` and ``[A]`` the agent's last action, and whether it is left to its driver; where
            agents decide in every step, the frame's are used instead.
        stage: ``[A]`` uint8: 0 has not decided yet, 1 decided before the stop line, 2 behind it.
        cursor: ``[5]`` see :data:`MEMBERS`.
    """

    vehicles: np.ndarray
    terms: np.ndarray
    sums: np.ndarray
    episode: np.ndarray
    agent_row: np.ndarray
    acting: np.ndarray
    members: np.ndarray
    leavers: np.ndarray
    wrong_lane_agents: np.ndarray
    order: np.ndarray
    lane_start: np.ndarray
    command: np.ndarray
    target_mps: np.ndarray
    release: np.ndarray
    capped: np.ndarray
    cap_mps: np.ndarray
    decision: np.ndarray
    deferred: np.ndarray
    stage: np.ndarray
    cursor: np.ndarray


PER_ROW = ("vehicles", "terms", "members", "leavers", "wrong_lane_agents", "order")
"""Tables with an entry per row."""


def empty_tables(config: EnvConfig, num_lanes: int, capacity: int = 0) -> Tables:
    """Return tables without vehicles, with ``capacity`` rows or more."""
    c, a = max(MIN_CAPACITY, config.num_vehicles, capacity), config.num_agents
    return Tables(
        vehicles=np.zeros(c, Vehicle),
        terms=np.zeros((c, NUM_TERMS)),
        sums=np.zeros((config.num_approaches, len(APPROACH_METRICS))),
        episode=np.zeros(len(EPISODE_METRICS)),
        agent_row=np.full(a, -1),
        acting=np.full(a, -1),
        members=np.zeros(c, np.int64),
        leavers=np.zeros(c, np.int64),
        wrong_lane_agents=np.zeros(c, np.int64),
        order=np.zeros(c, np.int64),
        lane_start=np.zeros(num_lanes + 1, np.int64),
        command=np.zeros(a, np.int64),
        target_mps=np.zeros(a),
        release=np.zeros(a, np.int64),
        capped=np.zeros(a, np.int64),
        cap_mps=np.zeros(a),
        decision=np.zeros((a, config.action_columns), np.float32),
        deferred=np.zeros(a, np.uint8),
        stage=np.zeros(a, np.uint8),
        cursor=np.zeros(5, np.int64),
    )


def with_double_rows(tables: Tables) -> Tables:
    """Return copies of the tables with twice the rows."""
    longer = {name: np.concatenate([old := getattr(tables, name), np.zeros_like(old)]) for name in PER_ROW}
    return tables._replace(**longer)


class Work(NamedTuple):
    """Working memory of a step; only ``written`` carries over to the next.

    Attributes:
        lane_fill: ``[L]``. own: ``[A, T]``. fleet, idling: ``[T]``. shared, own_shared: ``[S]``. step_reward: ``[A]``.
        rearmost: ``[P]``. blocked: ``[P, 2]``. idling_vehicle: ``[1]``, a record.
        past_horizon: ``[P, M]``, receives the sums of the steps after the horizon, which are discarded.
        written: ``[A]`` uint8, whether the slot's row of the frame's observation may be non-zero.
    """

    lane_fill: np.ndarray
    own: np.ndarray
    fleet: np.ndarray
    idling: np.ndarray
    shared: np.ndarray
    own_shared: np.ndarray
    step_reward: np.ndarray
    rearmost: np.ndarray
    blocked: np.ndarray
    past_horizon: np.ndarray
    idling_vehicle: np.ndarray
    written: np.ndarray


def working_memory(config: EnvConfig, num_lanes: int) -> Work:
    """Return the working memory of an episode."""
    a = config.num_agents
    return Work(
        lane_fill=np.zeros(num_lanes, np.int64),
        own=np.zeros((a, NUM_TERMS)),
        fleet=np.zeros(NUM_TERMS),
        idling=np.zeros(NUM_TERMS),
        shared=np.zeros(NUM_SHARED),
        own_shared=np.zeros(NUM_SHARED),
        step_reward=np.zeros(a),
        rearmost=np.zeros(config.num_approaches, np.int64),
        blocked=np.zeros((config.num_approaches, 2)),
        past_horizon=np.zeros((config.num_approaches, len(APPROACH_METRICS))),
        idling_vehicle=np.zeros(1, Vehicle),
        written=np.ones(a, np.uint8),
    )


VEHICLES, IDLE_GPS = range(2)
"""Columns of :attr:`Demand.blocked`."""


class Demand(NamedTuple):
    """All vehicles of the episode, ``[N]`` each, and which are blocked outside the region.

    Attributes:
        is_cv, approach, exit, length_m, moves_class: of the vehicle.
        cohort: whether the vehicle is scheduled to depart between warm-up and horizon.
        earliest_s: time at which it would reach the region at the speed limit.
        idle_gps: CO2 rate when idling on its approach, g/s.
        by_earliest: the vehicles in the order of ``earliest_s``.
        status: changes: status of the vehicle (:mod:`izoo.envs.mdp.credit`).
        blocked: ``[P, 2]``, changes: number of blocked vehicles, and their CO2 rate when idling, g/s.
        arrival_step: changes: steps played when the vehicle entered the region, :data:`NEVER` until then.
    """

    is_cv: np.ndarray
    approach: np.ndarray
    exit: np.ndarray
    length_m: np.ndarray
    moves_class: np.ndarray
    cohort: np.ndarray
    earliest_s: np.ndarray
    idle_gps: np.ndarray
    by_earliest: np.ndarray
    status: np.ndarray
    blocked: np.ndarray
    arrival_step: np.ndarray


def demand_arrays(
    config: EnvConfig, context: Context, road: RoadNet, traffic: Traffic, surrogates: KernelWeights
) -> Demand:
    """Return the arrays of an episode's traffic."""
    earliest_s = earliest_arrivals(road, traffic)
    return Demand(
        is_cv=np.ascontiguousarray(traffic.is_cv),
        approach=np.ascontiguousarray(traffic.approach),
        exit=np.ascontiguousarray(traffic.exit),
        length_m=np.ascontiguousarray(traffic.length_m),
        moves_class=np.ascontiguousarray(traffic.moves_class),
        cohort=cohort_of(config, traffic),
        earliest_s=earliest_s,
        idle_gps=idle_rates(context, road, traffic, surrogates),
        by_earliest=np.argsort(earliest_s, kind="stable"),
        status=np.zeros(len(traffic), np.int64),
        blocked=np.zeros((len(road.approaches), 2)),
        arrival_step=np.full(len(traffic), NEVER, np.int64),
    )


class Rules(NamedTuple):
    """Constants of an episode: decisions, weather, engine, reward and units, sensors, emitted groups."""

    step_s: float
    scope: int
    speeds: bool
    exit_limit_mps: np.ndarray
    hold_steps: int
    control_steps: int
    total_steps: int
    temperature_c: float
    humidity_pct: float
    electric: bool
    reward: Numbers
    weights: np.ndarray
    shared_weights: np.ndarray
    unit_g: np.ndarray
    fleet_g_per_step: float
    sensor_range_m: float
    columns: np.ndarray
    features: np.ndarray
    num_vehicles: int
    emit_vector: bool
    emit_vehicles: bool
    emit_signal: bool
    emit_metrics: bool
    emit_number: bool


def rules_of(config: EnvConfig, context: Context, road: RoadNet, traffic: Traffic, surrogates: KernelWeights) -> Rules:
    """Return the rules of an episode."""
    reward, weights, shared_weights = reward_arrays(config.reward)
    units = Units(np.ones(1), 1.0)
    if config.reward.sums:
        units = human_units(context, road, traffic, surrogates, config.horizon_s, config.step_s)
    return Rules(
        step_s=config.step_s,
        scope=SCOPES.index(config.decide),
        speeds=config.action == SPEED,
        exit_limit_mps=_exit_limits(road),
        hold_steps=config.hold_steps,
        control_steps=config.control_steps,
        total_steps=config.total_steps,
        temperature_c=context.temperature_c,
        humidity_pct=context.humidity_pct,
        electric=context.engine == "electric",
        reward=reward,
        weights=weights,
        shared_weights=shared_weights,
        unit_g=units.unit_g,
        fleet_g_per_step=units.fleet_g_per_step,
        sensor_range_m=np.inf if config.sensor_range_m is None else float(config.sensor_range_m),
        columns=neighbour_columns(config.neighbours),
        features=observed_table(context, road, config.observed),
        num_vehicles=config.num_vehicles,
        emit_vector="reward_vector" in config.emit,
        emit_vehicles="vehicles" in config.emit,
        emit_signal="signal" in config.emit,
        emit_metrics="metrics" in config.emit,
        emit_number=config.decide != STEP or "number" in config.emit,
    )


def _exit_limits(road: RoadNet) -> np.ndarray:
    """Return the speed limit in m/s of each exit, ``[Q]``."""
    limits = np.zeros(len(road.exits))
    leaving = road.lane_location == LEAVING
    np.maximum.at(limits, road.lane_exit[leaving], road.lane_limit_mps[leaving])
    return limits


class Frame(NamedTuple):
    """The frame's arrays that compiled code reads or writes in every step (:mod:`izoo.envs.mdp.frame`)."""

    action: np.ndarray
    defer: np.ndarray
    lane_change: np.ndarray
    observation: np.ndarray
    mask: np.ndarray
    decides: np.ndarray
    number: np.ndarray
    agent_vehicle: np.ndarray
    agent_terminated: np.ndarray
    agent_done: np.ndarray
    reward: np.ndarray
    reward_vector: np.ndarray
    team_reward: np.ndarray
    vehicle_floats: np.ndarray
    vehicle_ints: np.ndarray
    vehicle_flags: np.ndarray
    signal_colour: np.ndarray
    signal_time_left_s: np.ndarray
    approach_metrics: np.ndarray
    episode_metrics: np.ndarray


class WorldType(types.StructRef):  # type: ignore[misc]
    """Type of :class:`World` in compiled code."""


default_manager.register(WorldType, models.StructRefModel)


@infer_getattr
class _WorldAttribute(AttributeTemplate):  # type: ignore[misc]
    key = WorldType

    def generic_resolve(self, world: Any, name: str) -> Any:  # type: ignore[override]
        return world.field_dict.get(name)


def parts_of(context: Any, builder: Any, world: Any, value: Any) -> Any:
    """Return the parts of a world; numba's own accessor does not work in functions that do not count references."""
    box = cgutils.create_struct_proxy(world)(context, builder, value=value)
    words = builder.bitcast(box.meminfo, ir.IntType(8).as_pointer().as_pointer())
    data = builder.load(builder.gep(words, [ir.Constant(ir.IntType(64), _DATA_WORD)]))
    payload = world.get_data_type()
    kind = context.data_model_manager[payload].get_value_type().as_pointer()
    return cgutils.create_struct_proxy(payload)(context, builder, ref=builder.bitcast(data, kind))


@lower_getattr_generic(WorldType)
def _read_part(context: Any, builder: Any, world: Any, value: Any, name: str) -> Any:
    part = getattr(parts_of(context, builder, world, value), name)
    return impl_ret_borrowed(context, builder, world.field_dict[name], part)


@lower_setattr_generic(WorldType)
def _set_part(context: Any, builder: Any, signature: Any, args: Any, name: str) -> None:
    """Set a part of a new world."""
    world, kind = signature.args
    context.nrt.incref(builder, kind, args[1])
    setattr(parts_of(context, builder, world, args[0]), name, args[1])


class World(structref.StructRefProxy):  # type: ignore[misc]
    """Everything about an episode, as views for compiled code; nothing is copied.

    Passing this instead of some ninety arrays saves a fraction of a microsecond for each of them, in every step.
    """


structref.define_proxy(World, WorldType, ["tables", "work", "demand", "road", "clock", "rules", "surrogate", "frame"])


@compiled(borrows=True, inline="always")
def sums_to_horizon(world):  # type: ignore[no-untyped-def]
    """Return the table for the coming step's sums: after the horizon, one that is discarded."""
    if world.tables.episode[_STEPS] < world.rules.control_steps:
        return world.tables.sums
    return world.work.past_horizon


@compiled
def make_world(tables, work, demand, road, clock, rules, surrogate, frame):  # type: ignore[no-untyped-def]
    """Return a :class:`World`."""
    return World(tables, work, demand, road, clock, rules, surrogate, frame)
