"""Driving alone, in SUMO and on the twin: where every vehicle is after every step on the net, and where they part.

Nothing of the MDP is played; :mod:`izoo.benchmarks.fidelity.trajectory_diff` compares whole environments.
"""

from __future__ import annotations

import dataclasses
import itertools
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from izoo.contexts.context import Context
from izoo.envs.sumo.session import SumoSession, import_libsumo, sumo_arguments
from izoo.envs.twin.net.reader import TwinWorld, read_twin_world, twin_traffic
from izoo.envs.twin.runtime.layout import DRIVING
from izoo.envs.twin.runtime.simulation import TwinEpisode
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from izoo.results.rows_file import Key, Row, RowsFile
from izoo.results.selection import EpisodeSeeds
from izoo.traffic.sampling import Traffic, sample_traffic, write_routes

Commands = Callable[[int, np.ndarray, np.ndarray], np.ndarray]
"""From a step's number, vehicles ``[n]`` and their speeds ``[n]`` to commanded speeds ``[n]``, NaN for none."""


@dataclass
class Trace:
    """What happened: ``[T, N]`` lane (-1 where the vehicle is not on the road), position (m) and speed (m/s).

    ``signals``, of the same shape, are the vehicle's lamps as SUMO encodes them, 0 where it has none on.
    """

    lane: np.ndarray
    position_m: np.ndarray
    speed_mps: np.ndarray
    signals: np.ndarray

    @classmethod
    def empty(cls, steps: int, vehicles: int) -> Trace:
        shape = (steps, vehicles)
        return cls(np.full(shape, -1), np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, np.int64))


@dataclass
class Case:
    """An episode to play on both: a net, its traffic, and the length of a step."""

    world: TwinWorld
    net_path: Path
    traffic: Traffic
    seed: int
    step_ms: int = 500

    @classmethod
    def of(cls, context: Context, seed: int, horizon_s: float, step_ms: int = 500) -> Case:
        path = build_net(context.intersection)
        road = read_road(path)
        return cls(read_twin_world(road, path), path, sample_traffic(context, road, seed, horizon_s), seed, step_ms)

    def first(self, count: int) -> Case:
        """Return the same with the first ``count`` vehicles alone."""
        columns = {field.name: getattr(self.traffic, field.name) for field in dataclasses.fields(Traffic)}
        kept: dict[str, Any] = {
            name: column[:count] for name, column in columns.items() if isinstance(column, np.ndarray)
        }
        return dataclasses.replace(self, traffic=dataclasses.replace(self.traffic, **kept))


def waves(t: int, vehicles: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """Commands that speed up, brake to a standstill and give control back, each vehicle in its own time."""
    accel = 2.6 * np.sin(0.05 * t + vehicles * 1.3) - 0.3 + 3.0 * np.sin(0.013 * t * (1 + vehicles % 3))
    target = np.maximum(0.0, speeds + accel * 0.5)
    return np.where((vehicles % 4 == 3) | ((t // 50 + vehicles) % 5 == 0), np.nan, target)


def play_sumo(case: Case, steps: int, commands: Commands | None = None) -> Trace:
    """Play ``case`` in SUMO."""
    libsumo, session = import_libsumo(), SumoSession()
    rows = {name: row for row, name in enumerate(case.world.lane_ids)}
    trace = Trace.empty(steps, len(case.traffic))
    with tempfile.TemporaryDirectory() as folder:
        routes = Path(folder) / "traffic.rou.xml"
        write_routes(case.traffic, read_road(case.net_path), routes)
        session.load(sumo_arguments(case.net_path, routes, case.seed, case.step_ms / 1000.0))
        vehicle = libsumo.vehicle
        for t in range(steps):
            if commands is not None and t > 0:
                command(vehicle, t, trace, commands)
            session.advance()
            for name in vehicle.getIDList():
                v = int(name)
                trace.lane[t, v] = rows[vehicle.getLaneID(name)]
                trace.position_m[t, v] = vehicle.getLanePosition(name)
                trace.speed_mps[t, v] = vehicle.getSpeed(name)
                trace.signals[t, v] = vehicle.getSignals(name)
        session.close()
    return trace


def command(vehicle: object, t: int, trace: Trace, commands: Commands) -> None:
    """Pass the commands of step ``t`` on to SUMO."""
    there = np.flatnonzero(trace.lane[t - 1] >= 0)
    for v, speed in zip(there.tolist(), commands(t, there, trace.speed_mps[t - 1, there]).tolist(), strict=True):
        vehicle.setSpeed(str(v), -1.0 if np.isnan(speed) else speed)  # type: ignore[attr-defined]


def play_twin(case: Case, steps: int, commands: Commands | None = None) -> Trace:
    """Play ``case`` on the twin."""
    net = case.world.net
    episode = TwinEpisode(net, twin_traffic(case.traffic, read_road(case.net_path), net), case.step_ms)
    trace = Trace.empty(steps, len(case.traffic))
    for t in range(steps):
        if commands is not None and t > 0:
            there = np.flatnonzero(trace.lane[t - 1] >= 0)
            episode.command(there, commands(t, there, trace.speed_mps[t - 1, there]))
        episode.step()
        there = episode.status == DRIVING
        trace.lane[t, there] = episode.lane[there]
        trace.position_m[t, there] = episode.position_m[there]
        trace.speed_mps[t, there] = episode.speed_mps[there]
        trace.signals[t, there] = episode.signals[there]
    return trace


class Departure(NamedTuple):
    """Where two episodes part first: the step, the vehicle, and its (lane, m, m/s) in SUMO and on the twin.

    The lane is empty where the vehicle is not on the road, or not in what is compared.
    """

    step: int
    vehicle: int
    sumo: tuple[str, float, float]
    twin: tuple[str, float, float]

    def __str__(self) -> str:
        sides = (f"{lane or 'outside'} {at:.3f} m {speed:.3f} m/s" for lane, at, speed in (self.sumo, self.twin))
        return "step {} vehicle {}: SUMO {}; twin {}".format(self.step, self.vehicle, *sides)


def first_departure(case: Case, sumo: Trace, twin: Trace, tolerance: float = 1e-3) -> Departure | None:
    """Return where the traces differ first by more than ``tolerance`` (m, m/s), the largest difference first."""
    names = (*case.world.lane_ids, "")
    elsewhere = sumo.lane != twin.lane
    apart = np.fmax(np.abs(sumo.position_m - twin.position_m), np.abs(sumo.speed_mps - twin.speed_mps))
    apart = np.where(elsewhere, np.inf, np.nan_to_num(apart))
    steps = np.flatnonzero((apart > tolerance).any(axis=1))
    if len(steps) == 0:
        return None
    t = int(steps[0])
    v = int(np.argmax(apart[t]))
    sides = [
        (names[trace.lane[t, v]], float(trace.position_m[t, v]), float(trace.speed_mps[t, v])) for trace in (sumo, twin)
    ]
    return Departure(t, v, sides[0], sides[1])


HORIZON_S = 300.0
TOLERANCE = 1e-6
"""Positions and speeds (m, m/s) that differ by no more are the same."""
PLAYS = ((1, False), (2, False), (2, True))
"""How many vehicles, and whether their speeds are commanded, in waves."""
KEY = ("context_hash", "seed", "step_s", "vehicles", "commanded")
TEXT, NUMBERS = ("context_hash", "where"), ("seed", "step_s", "vehicles", "commanded", "parted")


def compare_few(contexts: Sequence[Context], seeds: EpisodeSeeds, step_s: float, kept: RowsFile) -> list[Row]:
    """Play the first vehicles of each context alone, unless the file has them; return a row for each play.

    A context with fewer vehicles has fewer rows. ``parted`` is the first step that differs by more than
    :data:`TOLERANCE`, missing where none does; ``where`` is the vehicle that differs there.
    """
    plays = {
        (context.content_hash, seeds.of(context)[0], step_s, *kind): context
        for context, kind in itertools.product(contexts, PLAYS)
    }

    def compare(key: Key, context: Context) -> list[Row]:
        _, seed, _, count, commanded = key
        case = Case.of(context, seed, HORIZON_S, round(1000.0 * step_s)).first(count)
        if len(case.traffic) < count:
            return []
        steps = round(HORIZON_S / step_s)
        sumo, twin = (play(case, steps, waves if commanded else None) for play in (play_sumo, play_twin))
        found = first_departure(case, sumo, twin, TOLERANCE)
        return [{"parted": None if found is None else found.step, "where": None if found is None else str(found)}]

    return kept.fill(KEY, plays, compare)
