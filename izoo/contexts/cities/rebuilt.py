"""The ten built-in cities, rebuilt from published statistics.

These are reconstructions: each city has the published distribution of every feature and the joint structure of Salt
Lake City, but no intersection is a copy of a measured one. Intersection ``k`` of a city is the same everywhere.

``get("atlanta")`` is a sequence of 621 :class:`IntersectionSpec`, each built when it is asked for.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from izoo.contexts.cities.copula import FEATURES, PHASES, RATIO, latent_root, quantiles, source_marginal
from izoo.contexts.cities.plans import MAX_CYCLE_S, Need, build_plan, yellow_time_s
from izoo.contexts.cities.shapes import SHAPES, Shape, share_out_lanes
from izoo.contexts.context import HOUR_FACTOR
from izoo.contexts.source import Lazy
from izoo.contexts.spec import LEG_NAMES, Approach, GhostSpec, IntersectionSpec, Leg
from izoo.errors import unknown_choice

SIZES = {
    "atlanta": 621,
    "boston": 917,
    "chicago": 2864,
    "dallas_fort_worth": 1570,
    "houston": 1014,
    "los_angeles": 4276,
    "salt_lake_city": 282,
    "new_york_manhattan": 2586,
    "san_francisco": 1209,
    "seattle": 995,
}
"""Signalised intersections per city (paper, appendix); 16,334 in all. The order is that of the catalogue's ids."""
CITIES = tuple(SIZES)
BUILD_SEED = 2410_15221
"""Published constant: the cities are built from it. Changing it would change every catalogue id's meaning."""
URGENCY = 100.0
"""Weight of a missing green share in the draw of phase counts: approaches that need a second phase get one first."""
POCKET_LENGTH_M = 36.0
"""Median length of the part with a turn pocket in the measured nets (26 to 42 m)."""
MIN_LENGTH_WITH_POCKET_M = 80.0
POCKET_CHANCE = {2: 0.5, 3: 0.65, 4: 0.35}
"""Share of approaches with a lane for lefts only, by lane count, whose left lane is a pocket (60 measured nets)."""


@dataclass(frozen=True)
class CityTable:
    """All features of a city.

    Attributes:
        shape: ``[N]`` index into :data:`SHAPES`.
        first: ``[N + 1]`` row at which the approaches of an intersection begin.
        features: ``[R, 7]`` values in the order of :data:`izoo.contexts.cities.copula.FEATURES`, one row per approach.
        chance: ``[R, 2]`` uniform numbers that decide about shared left lanes and pockets.
    """

    shape: np.ndarray
    first: np.ndarray
    features: np.ndarray
    chance: np.ndarray


def city_name(name: str) -> str:
    """Return the canonical name of a built-in city; hyphens and capitals are accepted."""
    canonical = name.strip().lower().replace("-", "_").replace(" ", "_")
    if canonical not in SIZES:
        raise unknown_choice("city", name, CITIES)
    return canonical


@functools.cache
def city_table(city: str) -> CityTable:
    """Draw the features of a whole city (some tens of milliseconds, once per process)."""
    generator = np.random.default_rng(np.random.SeedSequence([BUILD_SEED, CITIES.index(city)]))
    shape = generator.permutation(_shape_list(SIZES[city]))
    sizes = np.array([len(kind.incoming) for kind in SHAPES])[shape]
    first = np.concatenate([[0], np.cumsum(sizes)])
    latent = np.empty((first[-1], len(FEATURES)))
    for index, kind in enumerate(SHAPES):
        chosen = np.flatnonzero(shape == index)
        width = len(kind.incoming) * len(FEATURES)
        normals = generator.standard_normal((len(chosen), width)) @ latent_root(kind.relations)
        rows = (first[chosen][:, None] + np.arange(len(kind.incoming))).ravel()
        latent[rows] = normals.reshape(-1, len(FEATURES))
    values = np.empty_like(latent)
    for index, feature in enumerate(FEATURES):
        if index == PHASES:
            latent[:, PHASES] += URGENCY * _excess(shape, first, values[:, RATIO])
        values[:, index] = source_marginal(city, feature).at(quantiles(latent[:, index], generator))
    return CityTable(shape, first, values, generator.random((first[-1], 2)))


def _shape_list(count: int) -> np.ndarray:
    """Share out ``count`` intersections over the shapes by largest remainder."""
    exact = np.array([kind.weight for kind in SHAPES]) * count / sum(kind.weight for kind in SHAPES)
    counts = np.floor(exact).astype(int)
    for index in np.argsort(counts - exact, kind="stable")[: count - counts.sum()]:
        counts[index] += 1
    return np.repeat(np.arange(len(SHAPES)), counts)


def _excess(shape: np.ndarray, first: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Return, per approach, the green share that no plan can hold unless a right-turn overlap takes it."""
    excess = np.zeros(len(ratio))
    for index, kind in enumerate(SHAPES):
        starts = first[:-1][shape == index]
        place = {leg: position for position, leg in enumerate(kind.incoming)}
        largest = np.stack([np.max([ratio[starts + place[leg]] for leg in axis], axis=0) for axis in kind.axes], axis=1)
        room = 1.0 - 3.0 * len(kind.axes) / MAX_CYCLE_S
        for number, axis in enumerate(kind.axes):
            left_over = room - (largest.sum(axis=1) - largest[:, number])
            leads = largest[:, number] >= largest.max(axis=1)
            for leg in axis:
                if "r" in kind.turns[leg] and len(kind.turns[leg]) > 1:
                    rows = starts + place[leg]
                    excess[rows] = np.where(leads, np.maximum(ratio[rows] - left_over, 0.0), 0.0)
    return excess


def get(name: str) -> Lazy[IntersectionSpec]:
    """Return the intersections of a built-in city, each built when it is asked for."""
    city = city_name(name)
    return Lazy(SIZES[city], functools.partial(_build, city))


def _approaches(kind: Shape, rows: np.ndarray, chance: np.ndarray) -> dict[int, Approach]:
    """Build the incoming side of each incoming leg from its row of features."""
    approaches = {}
    for leg, row, (share, pocket) in zip(kind.incoming, rows, chance, strict=True):
        values = dict(zip(FEATURES, (float(value) for value in row), strict=True))
        count = int(values["lane_count"])
        lanes = share_out_lanes(list(kind.turns[leg]), count, values["phase_count"] >= 2, share)
        has_pocket = (
            lanes[-1] == "l"
            and lanes[0] != "l"
            and pocket < POCKET_CHANCE.get(count, 0.0)
            and values["lane_length_m"] >= MIN_LENGTH_WITH_POCKET_M
        )
        approaches[leg] = Approach(
            lanes=lanes,
            length_m=round(values["lane_length_m"], 2),
            speed_limit_mps=values["speed_limit_mps"],
            grade=round(values["grade"], 5),
            aadt_per_lane=round(values["inflow_peak_vph"] / HOUR_FACTOR["peak"], 1),
            left_pockets=int(has_pocket),
            pocket_length_m=POCKET_LENGTH_M if has_pocket else 0.0,
        )
    return approaches


def _exit_lanes(kind: Shape, approaches: dict[int, Approach], leg: int) -> int:
    """Lanes that an outgoing side needs so that each lane that turns into it finds its own."""
    feeds = [
        sum(turn in lane for lane in approach.lanes)
        for start, approach in approaches.items()
        for turn, exits in kind.turns[start].items()
        if LEG_NAMES[leg] in exits
    ]
    return max([1, *feeds]) if leg in kind.outgoing else 0


def _legs(kind: Shape, approaches: dict[int, Approach]) -> tuple[Leg, ...]:
    legs = []
    for leg, bearing in enumerate(kind.bearings):
        across = next((other for other in approaches if abs(kind.bearings[other] - bearing) == 180), None)
        like = (
            approaches.get(leg) or approaches.get(-1 if across is None else across) or next(iter(approaches.values()))
        )
        legs.append(
            Leg(
                name=LEG_NAMES[leg],
                bearing_deg=bearing,
                approach=approaches.get(leg),
                exit_lanes=_exit_lanes(kind, approaches, leg),
                exit_length_m=like.length_m,
                exit_speed_limit_mps=like.speed_limit_mps,
            )
        )
    return tuple(legs)


@functools.lru_cache(maxsize=4096)
def _build(city: str, index: int) -> IntersectionSpec:
    table = city_table(city)
    kind = SHAPES[table.shape[index]]
    rows = slice(table.first[index], table.first[index + 1])
    features = table.features[rows]
    approaches = _approaches(kind, features, table.chance[rows])
    needs = {}
    for leg, row in zip(kind.incoming, features, strict=True):
        lanes = approaches[leg].lanes
        exits = {
            turn: tuple((name, kind.bearings[LEG_NAMES.index(name)]) for name in names)
            for turn, names in kind.turns[leg].items()
            if any(turn in lane for lane in lanes)
        }
        own_left = lanes[-1] == "l" or "r" not in exits
        needs[LEG_NAMES[leg]] = Need(kind.bearings[leg], exits, int(row[PHASES]), float(row[RATIO]), own_left)
    axes = [[LEG_NAMES[leg] for leg in axis] for axis in kind.axes]
    yellow_s = yellow_time_s([approach.speed_limit_mps for approach in approaches.values()])
    return IntersectionSpec(
        name=f"{city}/{index}",
        source="city",
        legs=_legs(kind, approaches),
        signal_plan=build_plan(axes, needs, yellow_s),
        ghosts=GhostSpec(),
        right_on_red=True,
        city=city,
    )
