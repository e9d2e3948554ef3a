"""One episode in SUMO and on the twin, step by step: where they part, and how vehicles move on either."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from izoo.benchmarks.fidelity.driving_statistics import Conduct
from izoo.benchmarks.fidelity.single_vehicle import Departure
from izoo.contexts.context import Context
from izoo.envs import EcoDrivingEnv
from izoo.envs.config import STEP, EnvConfig
from izoo.envs.mdp.snapshot import Scene
from izoo.results.playing import Policy

TOLERANCE = 1e-3
"""Positions and speeds (m, m/s) that differ by no more are the same."""
SPEED_EDGES_MPS, ACCEL_EDGES_MPS2 = np.arange(0.0, 40.1, 0.25), np.arange(-10.0, 5.05, 0.1)


class Motion:
    """Counts of speeds and of accelerations of all vehicles and steps."""

    def __init__(self) -> None:
        self.speed = np.zeros(len(SPEED_EDGES_MPS) - 1)
        self.accel = np.zeros(len(ACCEL_EDGES_MPS2) - 1)

    def add(self, scene: Scene) -> None:
        """Count the vehicles of a step."""
        for counts, edges, name in (
            (self.speed, SPEED_EDGES_MPS, "speed_mps"),
            (self.accel, ACCEL_EDGES_MPS2, "accel_mps2"),
        ):
            counts += np.histogram(np.clip(scene.vehicles[name], edges[0], edges[-1]), edges)[0]


def parting(step: int, sumo: Scene, twin: Scene) -> Departure | None:
    """Return the vehicle that differs most between two scenes, or ``None`` where none differs."""
    places = [_places(scene) for scene in (sumo, twin)]
    nowhere = ("", np.nan, np.nan)
    worst, found = TOLERANCE, None
    for vehicle in sorted(places[0].keys() | places[1].keys()):
        here, there = (place.get(vehicle, nowhere) for place in places)
        apart = np.inf if here[0] != there[0] else max(abs(here[1] - there[1]), abs(here[2] - there[2]))
        if apart > worst:
            worst, found = apart, Departure(step, vehicle, here, there)
    return found


def _places(scene: Scene) -> dict[int, tuple[str, float, float]]:
    columns = scene.vehicles
    lanes = [scene.road.lane_ids[lane] for lane in columns["region_lane"].tolist()]
    positions, speeds = columns["lane_position_m"].tolist(), columns["speed_mps"].tolist()
    return dict(zip(columns["vehicle_number"].tolist(), zip(lanes, positions, speeds, strict=True), strict=True))


class Played(NamedTuple):
    """An episode that was played on both.

    Attributes:
        parting: where the two part, ``None`` where they never do.
        steps: how many it has; the two are compared after each decision.
        motions: how vehicles moved, in SUMO and on the twin.
        conducts: what drivers did; ``None`` where a decision lasts longer than a step, since then nobody sees when.
    """

    parting: Departure | None
    steps: int
    motions: tuple[Motion, Motion]
    conducts: tuple[Conduct, Conduct] | None


class SideBySide:
    """SUMO and the twin, for episodes that are played on both at once, in this process.

    Args:
        config: of both environments.
    """

    def __init__(self, config: EnvConfig) -> None:
        if config.decide != STEP:  # the same episode, and every step of it is compared
            config = dataclasses.replace(config, hold_s=config.step_s)
        self._sumo, self._twin = (EcoDrivingEnv(config=config, worker=0, simulator=name) for name in ("sumo", "twin"))

    def close(self) -> None:
        """End both."""
        self._sumo.close()
        self._twin.close()

    def play(self, policy: Policy, context: Context, seed: int) -> Played:
        """Play an episode to its end."""
        found: Departure | None = None
        motions, conducts = (Motion(), Motion()), (Conduct(), Conduct())
        environments: list[Any] = [self._sumo, self._twin]
        config = self._sumo.config
        counted = config.hold_steps == 1
        with torch.random.fork_rng(devices=[]), set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
            states = [env.reset(context=context, seed=seed) for env in environments]
            for decision in range(1, config.decisions + 1):
                step = min(decision * config.hold_steps, config.control_steps)
                # Policies that draw draw the same for both.
                for k, env in enumerate(environments):
                    torch.manual_seed(seed + decision)
                    states[k] = _advance(env, policy, states[k])
                scenes = [env.scene() for env in environments]
                for motion, conduct, scene in zip(motions, conducts, scenes, strict=True):
                    motion.add(scene)
                    if counted:
                        conduct.add(scene)
                found = found or parting(step, *scenes)
        return Played(found, step, motions, conducts if counted else None)


def _advance(env: Any, policy: Policy, state: TensorDictBase) -> TensorDictBase:
    return step_mdp(env.step(policy(state)), exclude_action=True)
