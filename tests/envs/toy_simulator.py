"""A simulator in sixty lines: vehicles that see neither each other nor the signals, and drive as they are commanded."""

from typing import Any

import numpy as np

from izoo.envs.backend import Play
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.episode import DemandAtHorizon, Reading
from izoo.envs.simulation import Simulation, Simulations


class Toy(Simulation):
    """Every vehicle keeps to its lane, and accelerates by 2 m/s^2 unless it is commanded."""

    def __init__(self, config: EnvConfig, frame: dict[str, np.ndarray], play: Play) -> None:
        super().__init__(config, frame, play)
        self.cars: dict[int, list[Any]] = {}  # by row: lane, position, speed, commanded speed, exit
        self.due: list[int] = []
        self.waiting = np.flatnonzero(self.traffic.depart_s >= config.warmup_s).tolist()
        self.episode.begin(self.reading(), config.warmup_s, [])

    def reading(self) -> Reading:
        cars = [self.cars[row] for row in self.episode.members.tolist()]
        lane, position, speed = (np.array([car[k] for car in cars], float) for k in range(3))
        return lane.astype(np.int64), position, speed, np.zeros(len(cars), np.int64)

    def step(self) -> None:
        episode, road, traffic, step_s = self.episode, self.road, self.traffic, self.config.step_s
        commands = episode.commands()
        for row in commands.release.tolist():
            self.cars[row][3] = None
        for row, target_mps in zip(commands.command.tolist(), commands.target_mps.tolist(), strict=True):
            self.cars[row][3] = target_mps
        for row, car in list(self.cars.items()):
            faster = min(car[2] + 2.0 * step_s, road.lane_limit_mps[car[0]])
            car[2] = faster if car[3] is None else car[3]
            car[1] += car[2] * step_s
            while car[0] >= 0 and car[1] > road.lane_length[car[0]]:
                car[1] -= road.lane_length[car[0]]
                car[0] = road.next_lane[car[0], car[4]]
            if car[0] < 0:
                del self.cars[row]
                episode.release(row)
        while self.waiting and traffic.depart_s[self.waiting[0]] <= episode.time_s:
            number = self.waiting.pop(0)
            lanes = road.next_lane[:, traffic.exit[number]] >= 0
            lanes &= (road.lane_approach == traffic.approach[number]) & (road.lane_location == 0)
            self.due.append(number)
            self.cars[episode.admit(number, 0.0)] = [int(np.argmax(lanes)), 0.0, 10.0, None, traffic.exit[number]]
        episode.write_frame(self.reading(), self.all_left)
        episode.end_step(lambda: DemandAtHorizon(self.due), self.all_left)

    def all_left(self) -> bool:
        return not self.cars and not self.waiting


class ToyBackend(Simulations):
    kind = Toy
