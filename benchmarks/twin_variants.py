"""Rows of the throughput benchmark on the twin: batches as training collects them."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict.nn import TensorDictModuleBase

from izoo.algos.ppo_config import PPOConfig
from izoo.algos.registry import make_algorithm
from izoo.benchmarks.stopwatch import CHUNK
from izoo.benchmarks.throughput_plan import VEHICLE_STEPS, Plan, Sample
from izoo.conf.train_options import TrainConfig, TrainingTwinConfig
from izoo.contexts.context import Context
from izoo.contexts.source import episode_seed
from izoo.envs.mdp.frame import TOTALS
from izoo.training.collectors import BatchSource

TWIN_ROWS = 4096
"""Steps of a batch from the twin over all its environments, about."""


@dataclass
class OnTwin:
    """Batches collected from the twin as training does, by default with a freshly initialised PPO policy.

    Args:
        plan: whose episodes are played, the same one by every ``plan.workers``-th environment.
        envs, threads: of the twin.
        surrogate: what computes CO2.
        policy: what acts.
    """

    plan: Plan
    envs: int
    threads: int
    surrogate: Literal["torch", "compiled"] = "torch"
    policy: TensorDictModuleBase | None = None

    def __call__(self, episode: int) -> tuple[Context, int]:
        """Return context and seed of an episode: the schedule of the scenario that is being played."""
        return self._context, episode_seed(0, episode % self.plan.workers)

    def play(self, scenario: int) -> Sample:
        """Time the batches of the next episodes, but for those of the first and the last two hundred steps."""
        self._context = self.plan.contexts[scenario]
        length = next(steps for steps in (200, 100, 50, 20, 10) if steps * self.envs <= TWIN_ROWS or steps == 10)
        agents, vehicle_steps, batches = 0, 0.0, self.plan.steps // length
        with contextlib.closing(self._start(length)) as source:
            for _ in range(CHUNK // length):
                source.next()
            if source.twin is not None:
                source.twin.backend.forget_ahead()  # their warm-up is longer here than what is timed
            begin = time.perf_counter()
            for _ in range(batches):
                batch = source.next()
                agents += int(batch["agents", "mask"].sum())
                counted = batch["next", TOTALS][..., VEHICLE_STEPS]
                vehicle_steps += float((counted[:, -1] - counted[:, 0]).sum())
            elapsed = time.perf_counter() - begin
        steps = batches * length * self.envs
        vehicles = vehicle_steps / (batches * (length - 1) * self.envs)
        return Sample(steps / elapsed, agents / elapsed, vehicles, agents / steps)

    def _start(self, length: int) -> BatchSource:
        options = TrainConfig(
            algo=PPOConfig(frames_per_batch=self.envs * length),
            simulator="twin",
            twin=TrainingTwinConfig(self.threads, self.surrogate, stagger=False),
            env=self.plan.env(emit=()),
            num_envs=self.envs,
        )
        torch.manual_seed(0)
        policy = self.policy or make_algorithm(options.algo, options.action, options.env).policy
        return BatchSource(options, policy, self)

    def close(self) -> None:
        pass
