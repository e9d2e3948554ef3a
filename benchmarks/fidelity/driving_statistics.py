"""What drivers do in an episode, counted: changes of lane, vehicles that pass on each signal, how queues leave."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from izoo.envs.mdp.snapshot import Scene
from izoo.networks.clock import GREEN, YELLOW, SignalClock
from izoo.networks.road import APPROACHING, RoadNet

STANDING_MPS = 0.1
START_UP_VEHICLES = 4
"""Headways count from the vehicle after these on, as the Highway Capacity Manual has it."""
PLACES = ("approach", "inside", "exit")
REASONS = ("needed", "left", "right")
TURNS = ("right", "straight", "left")
SHOWN = ("priority", "permissive", "yellow", "red")
COUNTS = (
    *(f"changes_{reason}_{place}" for reason, place in itertools.product(REASONS, PLACES)),
    *(f"passed_{turn}_{shown}" for turn, shown in itertools.product(TURNS, SHOWN)),
    *("queues", "start_up_s", "headways", "headway_s"),
)
"""What is counted.

- ``changes_*``: changes of lane; ``needed`` from a lane that does not lead to the exit, others to the ``left`` or
  ``right``.
- ``passed_*``: vehicles that left the approach, by what their movement was shown: a green with ``priority``, a
  ``permissive`` one that yields, yellow, or red (where turning right may be allowed after a stop).
- ``queues``: queues that began to leave by a green with priority; ``start_up_s``: from green until the first of them is
  over the line, summed; ``headways``, ``headway_s``: between those after the fourth, their number and their sum.
"""


@dataclass
class _Queue:
    """The vehicles that stood in a lane when its front got green, from the stop line on, and when each left."""

    green_s: float
    waiting: list[int]
    left_s: list[float] = field(default_factory=list)


class DrivingStatistics:
    """Counts :data:`COUNTS` of one episode from its scenes, which come in order, a step apart."""

    def __init__(self) -> None:
        self._counts: dict[str, float] = dict.fromkeys(COUNTS, 0.0)
        self._before: Scene | None = None
        self._lane: dict[int, int] = {}  # of each vehicle, in the scene before
        self._queues: dict[int, _Queue] = {}

    def add(self, scene: Scene) -> None:
        """Count what happened since the scene before."""
        columns, road = scene.vehicles, scene.road
        lanes = dict(zip(columns["vehicle_number"].tolist(), columns["region_lane"].tolist(), strict=True))
        if self._before is not None:
            # A signal changes at the beginning of a step, so the middle tells what is shown in it.
            phase = phase_at(road.clock, 0.5 * (self._before.time_s + scene.time_s))
            self._begin_queues(self._before, phase)
            exits, froms = columns["exit"].tolist(), columns["approach"].tolist()
            for row, (vehicle, lane) in enumerate(lanes.items()):
                before = self._lane.get(vehicle)
                if before is None or before == lane:
                    continue
                if road.lane_edge[before] == road.lane_edge[lane]:
                    self._change(road, before, lane, exits[row])
                elif road.lane_location[before] == APPROACHING != road.lane_location[lane]:
                    self._pass(scene, vehicle, before, (froms[row], exits[row]), phase)
        self._before, self._lane = scene, lanes

    def counts(self) -> dict[str, float]:
        """Return the counts so far, every name of :data:`COUNTS`, as if queues that still leave ended here."""
        counts = dict(self._counts)
        for queue in self._queues.values():
            _add_queue(counts, queue)
        return counts

    def _change(self, road: RoadNet, before: int, lane: int, exit_: int) -> None:
        place = PLACES[road.lane_location[before]]
        needed = place == "approach" and road.next_lane[before, exit_] < 0
        direction = "left" if road.lane_index[lane] > road.lane_index[before] else "right"
        self._counts[f"changes_{'needed' if needed else direction}_{place}"] += 1

    def _pass(self, scene: Scene, vehicle: int, lane: int, movement: tuple[int, int], phase: int) -> None:
        signal = shown(scene.road.clock, movement, phase)
        turn = int(scene.road.movement_turn[movement])
        self._counts[f"passed_{TURNS[turn]}_{signal}"] += 1
        queue = self._queues.get(lane)
        if queue is None:
            return
        if signal == "priority" and queue.waiting[0] == vehicle:
            queue.left_s.append(scene.time_s)
            del queue.waiting[0]
        if signal != "priority" or not queue.waiting or queue.left_s[-1:] != [scene.time_s]:
            self._end_queue(lane)

    def _begin_queues(self, scene: Scene, phase: int) -> None:
        """Begin the queues of ``scene`` whose front gets a green with priority that it did not have."""
        road, columns = scene.road, scene.vehicles
        last = phase_at(road.clock, scene.time_s - 1e-3)
        if last == phase:
            return
        order = np.argsort(-columns["lane_position_m"])
        seen: set[int] = set()
        for row in order[columns["speed_mps"][order] < STANDING_MPS].tolist():
            lane, vehicle = int(columns["region_lane"][row]), int(columns["vehicle_number"][row])
            movement = int(columns["approach"][row]), int(columns["exit"][row])
            if lane not in seen:
                seen.add(lane)
                ahead = road.next_lane[lane, movement[1]]
                at_line = road.lane_location[lane] == APPROACHING and road.lane_location[ahead] != APPROACHING
                new = [shown(road.clock, movement, k) == "priority" for k in (last, phase)] == [False, True]
                if ahead >= 0 and at_line and new:
                    self._end_queue(lane)
                    self._queues[lane] = _Queue(scene.time_s, [])
            if lane in self._queues and self._queues[lane].green_s == scene.time_s:
                self._queues[lane].waiting.append(vehicle)

    def _end_queue(self, lane: int) -> None:
        queue = self._queues.pop(lane, None)
        if queue is not None:
            _add_queue(self._counts, queue)


def _add_queue(counts: dict[str, float], queue: _Queue) -> None:
    """Count a queue, if any of it has left."""
    if not queue.left_s:
        return
    counts["queues"] += 1
    counts["start_up_s"] += queue.left_s[0] - queue.green_s
    if len(queue.left_s) > START_UP_VEHICLES:
        counts["headways"] += len(queue.left_s) - START_UP_VEHICLES
        counts["headway_s"] += queue.left_s[-1] - queue.left_s[START_UP_VEHICLES - 1]


def phase_at(clock: SignalClock, time_s: float) -> int:
    """Return the phase in force from ``time_s`` on."""
    in_cycle = (time_s - clock.offset_s) % clock.cycle_s
    return int(np.searchsorted(clock.phase_begin_s, in_cycle + 1e-6, side="right")) - 1


def shown(clock: SignalClock, movement: tuple[int, int], phase: int) -> str:
    """Return which of :data:`SHOWN` a movement is shown in a phase."""
    colour = clock.colour[movement][phase]
    if colour == GREEN:
        return "permissive" if clock.permissive[movement][phase] else "priority"
    return "yellow" if colour == YELLOW else "red"


def rates(counts: Mapping[str, float]) -> dict[str, float]:
    """Return what counts of many episodes, summed, say: by name, what is compared of SUMO and the twin.

    Returns:
        Changes of lane by reason, vehicles that passed, permissive lefts, those on red; the saturation flow
        (``saturation_flow_vph``, per lane) and the start-up lag (``start_up_lag_s``), NaN without queues long enough.
    """

    def summed(prefix: str, ending: str = "") -> float:
        return sum(value for name, value in counts.items() if name.startswith(prefix) and name.endswith(ending))

    def ratio(above: float, below: float) -> float:
        return above / below if below else float("nan")

    return {
        **{f"changes_{reason}": summed(f"changes_{reason}") for reason in REASONS},
        "passed": summed("passed"),
        "permissive_lefts": counts["passed_left_permissive"],
        "passed_on_red": summed("passed", "_red"),
        "saturation_flow_vph": ratio(3600.0 * counts["headways"], counts["headway_s"]),
        "start_up_lag_s": ratio(counts["start_up_s"], counts["queues"]),
    }
