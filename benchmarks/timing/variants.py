"""What the throughput benchmark times: bare libsumo, environments and collectors, each playing the same episodes.

A variant plays a scenario once per call: warm-up, some steps that are not timed, then those that are. Processes start
at the first play and are kept, asleep, until the variant is closed.
"""

from __future__ import annotations

import contextlib
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from izoo.algos.learners.base import ACTION, MASK
from izoo.algos.learners.ppo import PPOConfig
from izoo.algos.learners.registry import make_algorithm
from izoo.benchmarks.timing.bare_variants import Bare, BareSideBySide
from izoo.benchmarks.timing.stopwatch import CHUNK, seconds_per_step
from izoo.benchmarks.timing.throughput_plan import SAMPLE_STEPS, VEHICLE_STEPS, Plan, Sample, Variant
from izoo.conf.train_options import CollectorConfig, TrainConfig, TrainingTwinConfig
from izoo.console import counted
from izoo.contexts.context import Context
from izoo.contexts.source import Schedule, episode_seed
from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.envs.config import ACTION_HIGH_MPS2
from izoo.envs.mdp.frame import TOTALS
from izoo.training.collectors import BatchSource
from izoo.training.schedules import ShiftedSchedule

TWIN_ROWS = 4096
"""Steps of a batch from the twin over all its environments, about."""


def make_variants(plan: Plan, twins: Sequence[tuple[int, int]] = ()) -> dict[str, Variant]:
    """Return every variant by the name of its row; the first is what the others are compared with.

    Args:
        twins: environments and threads of each row of the twin; the last also with compiled CO2, and with a policy.
    """
    lean = plan.env(emit=())
    last = {threads: (envs, threads) for envs, threads in twins}.values()
    several = counted(plan.workers, "worker")
    return {
        "bare libsumo": Bare(plan),
        f"{several}, bare libsumo": BareSideBySide(plan),
        "one environment": Collected(plan, "single", FullAcceleration()),
        f"{several}, multisync": Collected(plan, "multisync", FullAcceleration()),
        f"{several}, parallel": Collected(plan, "parallel", FullAcceleration()),
        f"{several}, multisync, PPO": Collected(plan, "multisync"),
        f"{several}, parallel, PPO": Collected(plan, "parallel"),
        "one environment, step()": Single(plan, lean),
        "one, all groups, step()": Single(plan, plan.env()),
        **{_twin_label(*twin): OnTwin(plan, *twin, policy=FullAcceleration()) for twin in twins},
        **{f"{_twin_label(*twin)}, compiled CO2": OnTwin(plan, *twin, "compiled", FullAcceleration()) for twin in last},
        **{f"{_twin_label(*twin)}, PPO": OnTwin(plan, *twin) for twin in last},
    }


def _twin_label(envs: int, threads: int) -> str:
    return f"twin, {counted(envs, 'environment')}" + (f", {threads} threads" if threads > 1 else "")


class Single:
    """One environment in this process, stepped by hand, one episode after the other; its CVs accelerate fully."""

    def __init__(self, plan: Plan, config: EnvConfig) -> None:
        self.plan, self.config = plan, config

    def play(self, scenario: int) -> Sample:
        context, samples = self.plan.contexts[scenario], []
        with contextlib.closing(EcoDrivingEnv(context, config=self.config)) as env:
            for worker in range(self.plan.workers):
                state = env.reset(context=context, seed=episode_seed(0, worker))
                samples.append(_step(env, state, self.plan.steps))
        return _in_turn(samples)

    def close(self) -> None:
        pass


class FullAcceleration(TensorDictModuleBase):
    """No policy: every CV gets the same command, which costs next to nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [MASK], [ACTION]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the highest acceleration, ``[*B, A, 1]``."""
        return tensordict.set(ACTION, torch.full((*tensordict.get(MASK).shape, 1), ACTION_HIGH_MPS2))


@dataclass
class Collected:
    """Batches collected as training does, by default with a freshly initialised PPO policy.

    One environment plays the episodes one after the other, several play them side by side.
    """

    plan: Plan
    collector: Literal["single", "parallel", "multisync"]
    policy: TensorDictModuleBase | None = None
    _source: BatchSource | None = field(default=None, init=False)

    def play(self, scenario: int) -> Sample:
        """Play the next scenario; with several environments, episodes follow the plan's order, whatever its number."""
        if self.collector != "single":
            self._source = self._source or self._start(self.plan)
            return self._collect(self._source)
        # Libsumo in this process belongs to the other variants as well, so this one does not keep it.
        first = scenario * self.plan.rounds * self.plan.workers
        with contextlib.closing(self._start(ShiftedSchedule(self.plan, first))) as source:
            return _in_turn([self._collect(source) for _ in range(self.plan.workers)])

    @property
    def _envs(self) -> int:
        return 1 if self.collector == "single" else self.plan.workers

    def _collect(self, source: BatchSource) -> Sample:
        """Time the batches of the next episodes, but for the first and the last."""
        source.next()
        sample = _timed(source, self.plan.batches, CHUNK, self._envs)
        source.next()  # the episodes end in it
        return sample

    def _start(self, schedule: Schedule) -> BatchSource:
        collector, workers = CollectorConfig(name=self.collector), self.plan.workers
        return _source(self.plan, schedule, self.policy, self._envs * CHUNK, collector=collector, num_workers=workers)

    def close(self) -> None:
        if self._source is not None:
            self._source.close()


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
        twin = TrainingTwinConfig(self.threads, self.surrogate, stagger=False)
        options = {"simulator": "twin", "twin": twin, "num_envs": self.envs}
        with contextlib.closing(_source(self.plan, self, self.policy, self.envs * length, **options)) as source:
            for _ in range(CHUNK // length):
                source.next()
            if source.twin is not None:
                source.twin.backend.forget_ahead()  # their warm-up is longer here than what is timed
            return _timed(source, self.plan.steps // length, length, self.envs)

    def close(self) -> None:
        pass


def _source(
    plan: Plan, schedule: Schedule, policy: TensorDictModuleBase | None, frames_per_batch: int, **options: Any
) -> BatchSource:
    """Return a source of batches as training has it; without a policy, of a freshly initialised one."""
    config = TrainConfig(algo=PPOConfig(frames_per_batch=frames_per_batch), env=plan.env(emit=()), **options)
    torch.manual_seed(0)
    policy = policy or make_algorithm(config.algo, config.action, config.env).policy
    return BatchSource(config, policy, schedule)


def _timed(source: BatchSource, batches: int, length: int, envs: int) -> Sample:
    """Time batches of so many steps in each of so many environments."""
    agents, vehicle_steps, begin = 0, 0.0, time.perf_counter()
    for _ in range(batches):
        batch = source.next()
        agents += int(batch["agents", "mask"].sum())
        driven = batch["next", TOTALS][..., VEHICLE_STEPS]
        vehicle_steps += float((driven[:, -1] - driven[:, 0]).sum())
    elapsed = time.perf_counter() - begin
    steps = batches * length * envs
    vehicles = vehicle_steps / (batches * (length - 1) * envs)
    return Sample(steps / elapsed, agents / elapsed, vehicles, agents / steps)


def _in_turn(samples: Sequence[Sample]) -> Sample:
    """Return the rates and means of episodes of the same number of steps that were played one after the other."""
    env_steps, _, vehicles, agents = zip(*samples, strict=True)
    rate = statistics.harmonic_mean(env_steps)
    return Sample(rate, rate * statistics.mean(agents), statistics.mean(vehicles), statistics.mean(agents))


def _step(env: EcoDrivingEnv, state: TensorDictBase, steps: int) -> Sample:
    """Step an environment from ``state`` on, with the highest acceleration as every CV's action."""
    taken = 0
    vehicle_steps: list[float] = []
    agents_seen: list[float] = []
    action = torch.full((env.config.num_agents, 1), ACTION_HIGH_MPS2)
    totals, mask = env.frames["episode_metrics"], env.frames["mask"]

    def step() -> None:
        nonlocal state, taken
        if taken % SAMPLE_STEPS == 0 and taken >= CHUNK:
            agents_seen.append(mask.sum())
            vehicle_steps.append(totals[0, VEHICLE_STEPS])
        state.set(ACTION, action)
        _, state = env.step_and_maybe_reset(state)
        taken += 1

    rate = 1.0 / seconds_per_step(step, steps, CHUNK)
    agents = float(np.mean(agents_seen))
    vehicles = float(np.diff(vehicle_steps).mean()) / SAMPLE_STEPS
    return Sample(rate, rate * agents, vehicles, agents)
