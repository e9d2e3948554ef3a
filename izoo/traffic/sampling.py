"""The vehicles of one episode, and the SUMO route file that inserts them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from izoo.contexts.context import Context
from izoo.contexts.spec import LEG_NAMES
from izoo.errors import IzooError
from izoo.files import write_text
from izoo.networks.road import RoadNet
from izoo.networks.turning import exit_shares
from izoo.traffic.demand import STRAIGHT_SOURCE_SHARE, draw_index, poisson_arrivals
from izoo.traffic.drivers import sample_drivers
from izoo.traffic.fleet import CLASS_SOURCE_TYPE, lengths_m, sample_classes

SOURCE_KINDS = ("AB", "AA")
"""Names of the sources by their index in :attr:`Traffic.source`: from straight on, and turning in."""
DEPART_SPEED_MPS = 5.0
PAPER_CV = {"length_m": 5.0, "min_gap_m": 2.0, "tau_s": 1.0, "accel_mps2": 2.6, "decel_mps2": 4.5}
"""The published vehicle parameters of an uncommanded CV."""

# Streams of randomness. Their numbers are part of the meaning of a seed: never renumber them.
_ARRIVALS, _ROUTES, _FLEET, _DRIVERS, _ADOPTION = range(5)


@dataclass(frozen=True)
class Traffic:
    """``N`` vehicles in the order of their departure; row ``k`` is the vehicle with SUMO id ``str(k)``.

    Attributes:
        depart_s: ``[N]`` float64, ascending: when the vehicle wants to enter its source edge.
        approach: ``[N]`` int64, index into the road's approaches.
        exit: ``[N]`` int64, index into the road's exits.
        source: ``[N]`` int64, index into :data:`SOURCE_KINDS`.
        depart_lane: ``[N]`` int64, lane of the source edge by SUMO's index, 0 rightmost.
        is_cv: ``[N]`` bool: a controlled vehicle.
        source_type: ``[N]`` int64, MOVES source type.
        moves_class: ``[N]`` int64, index into :data:`izoo.emissions.classes.CLASSES`.
        length_m, min_gap_m, tau_s, accel_mps2, decel_mps2: ``[N]`` float64, the vehicle parameters that SUMO uses.
        cv_vehicle: origin of the CVs' parameters, see :class:`~izoo.contexts.context.Context`.
    """

    depart_s: np.ndarray
    approach: np.ndarray
    exit: np.ndarray
    source: np.ndarray
    depart_lane: np.ndarray
    is_cv: np.ndarray
    source_type: np.ndarray
    moves_class: np.ndarray
    length_m: np.ndarray
    min_gap_m: np.ndarray
    tau_s: np.ndarray
    accel_mps2: np.ndarray
    decel_mps2: np.ndarray
    cv_vehicle: str

    def __len__(self) -> int:
        return len(self.depart_s)


_COLUMNS = tuple(field.name for field in dataclasses.fields(Traffic) if field.name != "cv_vehicle")


def sample_traffic(context: Context, road: RoadNet, seed: int, duration_s: float) -> Traffic:
    """Draw the vehicles of an episode; they depend on the arguments alone.

    Every leg has its own streams of randomness, one per purpose. So the same seed at another adoption level changes
    only which vehicles are CVs (those of a lower level are among those of a higher one), and a leg has the same
    vehicles whether or not the others have demand.

    Args:
        context: demand, adoption and CV parameters.
        road: the net of the context's intersection.
        seed: the episode's seed, not negative.
        duration_s: vehicles arrive in ``[0, duration_s)``.

    Raises:
        IzooError: the seed is negative, or a leg with demand has no source edge or leads nowhere.
    """
    if seed < 0:
        raise IzooError(f"the episode seed is {seed}; give an integer from 0 upwards.")
    parts = [
        _approach_traffic(context, road, p, seed, duration_s)
        for p, leg in enumerate(road.approaches)
        if context.flow_vph_per_lane(leg) > 0.0
    ]
    columns = {name: np.concatenate([_EMPTY[name], *(part[name] for part in parts)]) for name in _COLUMNS}
    order = np.argsort(columns["depart_s"], kind="stable")
    return Traffic(**{name: column[order] for name, column in columns.items()}, cv_vehicle=context.cv_vehicle)


def with_late_vehicle(traffic: Traffic, number: int, late_s: float) -> Traffic:
    """Return the traffic in which one vehicle of every approach departs later.

    Args:
        traffic: as drawn.
        number: which vehicle of each approach, counted from 1 in the order of departure; approaches with fewer vehicles
            are left as they are, and 0 changes nothing.
        late_s: how much later.
    """
    depart_s = traffic.depart_s.copy()
    for approach in np.unique(traffic.approach) if number else ():
        depart_s[np.flatnonzero(traffic.approach == approach)[number - 1 : number]] += late_s
    order = np.argsort(depart_s, kind="stable")
    columns = {name: getattr(traffic, name)[order] for name in _COLUMNS}
    return dataclasses.replace(traffic, **{**columns, "depart_s": depart_s[order]})


_EMPTY: dict[str, np.ndarray] = {
    **{name: np.zeros(0, np.int64) for name in ("approach", "exit", "source", "depart_lane")},
    **{name: np.zeros(0, np.int64) for name in ("source_type", "moves_class")},
    **{name: np.zeros(0) for name in ("depart_s", *PAPER_CV)},
    "is_cv": np.zeros(0, bool),
}


def _approach_traffic(context: Context, road: RoadNet, p: int, seed: int, duration_s: float) -> dict[str, np.ndarray]:
    """Return the columns of one approach's vehicles, in the order of their arrival."""
    leg = road.approaches[p]
    approach = context.intersection.leg(leg).approach
    shares = exit_shares(approach, road.exits, road.movement_turn[p], road.movement_links[p])
    present = [kind in road.sources[p] for kind in SOURCE_KINDS]
    if not shares.any() or not any(present):
        missing = "source edge" if shares.any() else "way through the junction"
        raise IzooError(f"leg {leg} of {context.intersection.name} has demand but no {missing}; set its AADT to 0.")

    def stream(purpose: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(purpose, LEG_NAMES.index(leg))))

    # Independent Poisson processes per (route, lane) are one process whose arrivals draw their route and lane.
    rate_per_s = context.flow_vph_per_lane(leg) * float(road.main_lane_count[p]) / 3600.0
    depart_s = poisson_arrivals(stream(_ARRIVALS), rate_per_s, duration_s)
    count = len(depart_s)
    source_draw, exit_draw, lane_draw = stream(_ROUTES).random((count, 3)).T
    source = (
        np.where(source_draw < STRAIGHT_SOURCE_SHARE, 0, 1) if all(present) else np.full(count, present.index(True))
    )
    # A source may have more lanes than the approach, and some that are closed to cars.
    lanes = [road.source_lanes[p].get(kind, (0,))[: int(road.main_lane_count[p])] for kind in SOURCE_KINDS]
    widest = max(map(len, lanes))
    lane_table = np.array([row + row[:1] * (widest - len(row)) for row in lanes])
    lane_row = (lane_draw * np.array([len(row) for row in lanes])[source]).astype(np.int64)
    moves_class = sample_classes(stream(_FLEET), count, context.fleet)
    source_type = CLASS_SOURCE_TYPE[moves_class]
    drivers = sample_drivers(stream(_DRIVERS), source_type, context.drivers)
    is_cv = stream(_ADOPTION).random(count) < context.adoption
    parameters = dict(zip(PAPER_CV, (lengths_m(source_type), *drivers), strict=True))
    if context.cv_vehicle == "paper":
        parameters = {name: np.where(is_cv, PAPER_CV[name], value) for name, value in parameters.items()}
    return {
        "depart_s": depart_s,
        "approach": np.full(count, p),
        "exit": draw_index(exit_draw, shares),
        "source": source,
        "depart_lane": lane_table[source, lane_row],
        "is_cv": is_cv,
        "source_type": source_type,
        "moves_class": moves_class,
        **parameters,
    }


def write_routes(traffic: Traffic, road: RoadNet, path: str | Path) -> None:
    """Write the vehicles as a SUMO route file, atomically; vehicle ids are row numbers.

    Every driver is a vehicle type of its own (``d<row>``); CVs with the published parameters share the type ``cv``.
    """
    used = set(zip(traffic.approach.tolist(), traffic.source.tolist(), traffic.exit.tolist(), strict=True))
    lines = ["<routes>"]
    lines += [
        f'<route id="{_route_id(p, source, q)}" edges="{_edges(road, p, source, q)}"/>' for p, source, q in sorted(used)
    ]
    shared = traffic.is_cv & (traffic.cv_vehicle == "paper")
    if shared.any():
        lines.append(_vehicle_type("cv", *PAPER_CV.values()))
    speeds = [min(DEPART_SPEED_MPS, limit) for limit in road.speed_limit_mps.tolist()]
    columns = [getattr(traffic, name).tolist() for name in ("depart_s", "approach", "source", "exit", "depart_lane")]
    parameters = [getattr(traffic, name).tolist() for name in PAPER_CV]
    for row, (is_shared, depart, p, source, q, lane, *driver) in enumerate(
        zip(shared.tolist(), *columns, *parameters, strict=True)
    ):
        if not is_shared:
            lines.append(_vehicle_type(f"d{row}", *driver))
        kind = "cv" if is_shared else f"d{row}"
        lines.append(
            f'<vehicle id="{row}" type="{kind}" route="{_route_id(p, source, q)}" depart="{depart:.3f}"'
            f' departLane="{lane}" departPos="base" departSpeed="{speeds[p]}"/>'
        )
    lines.append("</routes>\n")
    write_text(Path(path), "\n".join(lines), durable=False)


def _route_id(p: int, source: int, q: int) -> str:
    return f"r{p}.{source}.{q}"


def _edges(road: RoadNet, p: int, source: int, q: int) -> str:
    return " ".join((road.sources[p][SOURCE_KINDS[source]], *road.incoming_edges[p], road.outgoing_edge[q]))


def _vehicle_type(name: str, length: float, min_gap: float, tau: float, accel: float, decel: float) -> str:
    return (
        f'<vType id="{name}" carFollowModel="IDM" length="{length:g}" minGap="{min_gap:.4f}" tau="{tau:.4f}"'
        f' accel="{accel:.4f}" decel="{decel:.4f}" speedFactor="1" speedDev="0" laneChangeModel="LC2013"/>'
    )
