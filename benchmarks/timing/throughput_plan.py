"""What every row of the throughput benchmark plays: scenarios, the plan of their episodes, and what a play tells."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

from izoo.benchmarks.timing.stopwatch import CHUNK
from izoo.contexts.context import Context
from izoo.contexts.procedural import procedural_context
from izoo.contexts.source import episode_seed
from izoo.envs import EnvConfig
from izoo.envs.mdp.metric_sums import EPISODE_METRICS

WARMUP_S = 350.0
"""Time in which the region fills, with nobody commanding."""
SAMPLE_STEPS = 20
"""Agents and vehicles are counted once in so many steps, so that counting takes next to no part of the time."""
AGENT_SLOTS = 96
VEHICLE_STEPS = EPISODE_METRICS.index("vehicle_steps")


class Sample(NamedTuple):
    """Rates of one play over all its environments, and means per environment."""

    env_steps_per_s: float
    agent_steps_per_s: float
    vehicles: float
    agents: float


class Variant(Protocol):
    """One row of the table."""

    def play(self, scenario: int) -> Sample:
        """Play scenario number ``scenario`` once; scenarios come in order, each as often as the plan says."""
        ...

    def close(self) -> None:
        """End the processes."""
        ...


def scenarios() -> dict[str, Context]:
    """Contexts with about 20, 60 and 190 vehicles in the controlled region, a third of them CVs."""
    roads = {"lane_count": 3, "phase_count": 2, "green_s": 30.0, "red_s": 24.0}
    return {
        "light": procedural_context(lane_count=1, inflow_vph_per_lane=500.0, lane_length_m=350.0),
        "medium": procedural_context(**roads, inflow_vph_per_lane=430.0, lane_length_m=400.0),
        "heavy": procedural_context(**roads, inflow_vph_per_lane=330.0, lane_length_m=400.0, approach="all"),
    }


@dataclass(frozen=True)
class Plan:
    """What is played; also the schedule of the environments' episodes.

    Attributes:
        contexts: of the scenarios, in the order in which they are played.
        rounds: plays of each scenario.
        workers: environments side by side; number ``k`` plays an episode of seed ``k``, the same in every round.
        steps: timed steps per environment and play.
    """

    contexts: tuple[Context, ...]
    rounds: int
    workers: int
    steps: int

    def __call__(self, episode: int) -> tuple[Context, int]:
        """Return context and seed of an episode; after the last play comes the last scenario again."""
        play, worker = divmod(episode, self.workers)
        scenario = min(play // self.rounds, len(self.contexts) - 1)
        return self.contexts[scenario], episode_seed(0, worker)

    @property
    def batches(self) -> int:
        """Timed batches of a play."""
        return self.steps // CHUNK

    def env(self, **options: Any) -> EnvConfig:
        """Return settings whose episode is one play of a collector: a batch before the timed ones and one after."""
        episode = EnvConfig(warmup_s=WARMUP_S, num_agents=AGENT_SLOTS, **options)
        steps = episode.warmup_steps + (self.batches + 2) * CHUNK
        return replace(episode, horizon_s=steps * episode.step_s)
