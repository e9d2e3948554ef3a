"""A simulator in sixty lines: vehicles that see neither each other nor the signals, and drive as they are commanded."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from izoo.emissions.weights import load_weights
from izoo.envs.backend import Play, episode_traffic
from izoo.envs.config import EnvConfig
from izoo.envs.env import Contexts, EcoDrivingBase, numbering
from izoo.envs.mdp.episode import DemandAtHorizon, Episode, Reading
from izoo.envs.mdp.frame import frame_bytes, map_frames, row_of
from izoo.envs.mdp.snapshot import Scene
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road


class Toy:
    """One environment: every vehicle keeps to its lane, and accelerates by 2 m/s^2 unless it is commanded."""

    def __init__(self, config: EnvConfig, frame: dict[str, np.ndarray], play: Play) -> None:
        road = read_road(build_net(play.context.intersection))
        self.traffic = episode_traffic(config, play.context, road, play.seed)
        self.episode = Episode(config, frame, load_weights(), *play, road, self.traffic)
        self.step_s, self.road = config.step_s, road
        self.cars: dict[int, list[Any]] = {}  # by row: lane, position, speed, commanded speed, exit
        self.waiting = [k for k in range(len(self.traffic)) if self.traffic.depart_s[k] >= config.warmup_s]
        self.due: list[int] = []
        self.episode.begin(self.reading(), config.warmup_s, [])

    def reading(self) -> Reading:
        cars = [self.cars[row] for row in self.episode.members.tolist()]
        lane, position, speed = (np.array([car[k] for car in cars], float) for k in range(3))
        return lane.astype(np.int64), position, speed, np.zeros(len(cars), np.int64)

    def step(self) -> None:
        episode, road = self.episode, self.road
        commands = episode.commands()
        for row in commands.release.tolist():
            self.cars[row][3] = None
        for row, target_mps in zip(commands.command.tolist(), commands.target_mps.tolist(), strict=True):
            self.cars[row][3] = target_mps
        for row, car in list(self.cars.items()):
            faster = min(car[2] + 2.0 * self.step_s, road.lane_limit_mps[car[0]])
            car[2] = faster if car[3] is None else car[3]
            car[1] += car[2] * self.step_s
            while car[0] >= 0 and car[1] > road.lane_length[car[0]]:
                car[1] -= road.lane_length[car[0]]
                car[0] = road.next_lane[car[0], car[4]]
            if car[0] < 0:
                del self.cars[row]
                episode.release(row)
        while self.waiting and self.traffic.depart_s[self.waiting[0]] <= episode.time_s:
            number = self.waiting.pop(0)
            approach, leaving = self.traffic.approach[number], self.traffic.exit[number]
            first = (road.lane_approach == approach) & (road.lane_location == 0) & (road.next_lane[:, leaving] >= 0)
            self.due.append(number)
            self.cars[episode.admit(number, 0.0)] = [int(np.flatnonzero(first)[0]), 0.0, 10.0, None, leaving]
        all_left = lambda: not self.cars and not self.waiting  # noqa: E731
        episode.write_frame(self.reading(), all_left)
        episode.end_step(lambda: DemandAtHorizon(self.due, (), (), (), ()), all_left)


class ToyBackend:
    """A :class:`~izoo.envs.backend.Backend` of ``count`` environments."""

    closed = False

    def __init__(self, config: EnvConfig, count: int) -> None:
        self.config, self.count, self.toys = config, count, dict[int, Toy]()
        self.frames = map_frames(bytearray(frame_bytes(config, count)), config, count)

    @property
    def started(self) -> bool:
        return len(self.toys) == self.count

    def begin(self, plays: Mapping[int, Play]) -> None:
        self.toys |= {k: Toy(self.config, row_of(self.frames, k), play) for k, play in plays.items()}

    def step(self, meanwhile: Callable[[], None] | None = None) -> Sequence[int]:
        for toy in self.toys.values():
            if not toy.episode.over:
                toy.step()
                while not toy.episode.between_decisions:
                    toy.step()
        return ()

    def scene(self, index: int = 0) -> Scene:
        return self.toys[index].episode.scene()

    def close(self) -> None:
        self.toys.clear()


class ToyEnv(EcoDrivingBase):
    """Environments side by side."""

    def __init__(
        self,
        num_envs: int,
        contexts: Contexts | None = None,
        *,
        config: EnvConfig,
        seed: int = 0,
        shard: int | None = None,
        **_: Any,
    ) -> None:
        backend = ToyBackend(config, num_envs)
        numbers = numbering(shard, 1, num_envs, seed)
        super().__init__(contexts, config, seed, [num_envs], backend.frames, backend, *numbers)


def single(config: EnvConfig) -> tuple[dict[str, np.ndarray], ToyBackend]:
    """One environment."""
    backend = ToyBackend(config, 1)
    return backend.frames, backend
