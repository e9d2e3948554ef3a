"""An episode in SUMO and on the twin, decision by decision: where they part, and how vehicles move on either."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence

import numpy as np
from tensordict import TensorDictBase

from izoo.benchmarks.fidelity.single_vehicle import Departure
from izoo.contexts.context import Context
from izoo.envs import SIMULATORS, EcoDrivingEnv
from izoo.envs.config import STEP, EnvConfig
from izoo.envs.mdp.snapshot import Scene
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from izoo.results.playing import Policy, run_episode
from izoo.results.policies import NamedPolicy
from izoo.results.rows_file import Key, Row, RowsFile
from izoo.results.selection import EpisodeSeeds

TOLERANCE = 1e-3
"""Positions and speeds (m, m/s) that differ by no more are the same."""
SPEED_EDGES_MPS, ACCEL_EDGES_MPS2 = np.arange(0.0, 40.1, 0.25), np.arange(-10.0, 5.05, 0.1)
HISTOGRAMS = {"ks_speed": ("speed_mps", SPEED_EDGES_MPS), "ks_accel": ("accel_mps2", ACCEL_EDGES_MPS2)}
KEY = ("policy", "weights", "context_hash", "seed")
TEXT = ("policy", "weights", "context_hash", "context", "demand", "where")
NUMBERS = ("seed", "adoption", "lanes", "decisions", "parted", *HISTOGRAMS)
Places = dict[int, tuple[str, float, float]]
"""Lane, position (m) and speed (m/s) by vehicle."""


class Watched:
    """An episode on one simulator: where every vehicle is before each decision.

    Attributes:
        places: before each decision.
        histograms: counts of speeds and of accelerations of all vehicles and decisions.
    """

    def __init__(self, env: EcoDrivingEnv, policy: Policy, context: Context, seed: int) -> None:
        self.places: list[Places] = []
        self.histograms = {name: np.zeros(len(edges) - 1) for name, (_, edges) in HISTOGRAMS.items()}

        def act(state: TensorDictBase) -> TensorDictBase:
            self._add(env.scene())
            return policy(state)

        run_episode(env, act, context, seed)

    def _add(self, scene: Scene) -> None:
        self.places.append(places(scene))
        for name, (column, edges) in HISTOGRAMS.items():
            self.histograms[name] += np.histogram(np.clip(scene.vehicles[column], edges[0], edges[-1]), edges)[0]


def places(scene: Scene) -> Places:
    """Return where the vehicles of a scene are."""
    columns = scene.vehicles
    lanes = [scene.road.lane_ids[lane] for lane in columns["region_lane"].tolist()]
    positions, speeds = columns["lane_position_m"].tolist(), columns["speed_mps"].tolist()
    return dict(zip(columns["vehicle_number"].tolist(), zip(lanes, positions, speeds, strict=True), strict=True))


def parting(step: int, sumo: Places, twin: Places) -> Departure | None:
    """Return the vehicle that differs most at a moment, or ``None`` where none differs."""
    nowhere = ("", np.nan, np.nan)
    worst, found = TOLERANCE, None
    for vehicle in sorted(sumo.keys() | twin.keys()):
        here, there = sumo.get(vehicle, nowhere), twin.get(vehicle, nowhere)
        apart = np.inf if here[0] != there[0] else max(abs(here[1] - there[1]), abs(here[2] - there[2]))
        if apart > worst:
            worst, found = apart, Departure(step, vehicle, here, there)
    return found


def compared(sumo: Watched, twin: Watched, hold_steps: int = 1) -> Row:
    """Compare an episode on both.

    Returns:
        ``decisions``, ``parted`` (the first step that differs; missing where none does), ``where`` (the vehicle that
        differs there), ``ks_speed`` and ``ks_accel``.
    """
    both = enumerate(zip(sumo.places, twin.places, strict=False))
    found = next((apart for k, pair in both if (apart := parting(k * hold_steps, *pair)) is not None), None)
    return {
        "decisions": min(len(sumo.places), len(twin.places)),
        "parted": None if found is None else found.step,
        "where": None if found is None else str(found),
        **{name: ks_distance(sumo.histograms[name], twin.histograms[name]) for name in HISTOGRAMS},
    }


def compare_steps(
    contexts: Sequence[Context], seeds: EpisodeSeeds, env: EnvConfig, policies: Sequence[NamedPolicy], kept: RowsFile
) -> list[Row]:
    """Compare each context's first episode up to its horizon, unless the file has it; return a row for each.

    Contexts without demand have none. Rows have the columns :data:`TEXT` and :data:`NUMBERS`.
    """
    env = dataclasses.replace(env, drain_s=0.0, emit=())
    if env.decide != STEP:  # the same episode, and every step of it is compared
        env = dataclasses.replace(env, hold_s=env.step_s)
    plays = {
        (each.name, each.record.weights, context.content_hash, seeds.of(context)[0]): (each, context)
        for context in contexts
        if context.demand_approaches
        for each in policies
    }

    def compare(key: Key, play: tuple[NamedPolicy, Context]) -> list[Row]:
        named, context = play
        road = read_road(build_net(context.intersection))
        about = {
            "context": context.name,
            "adoption": context.adoption,
            "demand": "all" if context.approach is None else "one",
            "lanes": max(int(road.lane_count[road.approaches.index(leg)]) for leg in context.demand_approaches),
        }
        sumo, twin = (Watched(each, named.policy, context, key[-1]) for each in environments)
        return [about | compared(sumo, twin, env.hold_steps)]

    with contextlib.ExitStack() as stack:
        environments = [EcoDrivingEnv(config=env, simulator=name) for name in SIMULATORS]
        for each in environments:
            stack.callback(each.close)
        return kept.fill(KEY, plays, compare)


def ks_distance(one: np.ndarray, other: np.ndarray) -> float | None:
    """Return the Kolmogorov-Smirnov distance of two histograms over the same bins; ``None`` where one is empty."""
    if not one.sum() or not other.sum():
        return None
    return float(np.abs(np.cumsum(one) / one.sum() - np.cumsum(other) / other.sum()).max())
