"""What the throughput benchmark times: bare libsumo, environments and collectors, each playing the same episodes.

A variant plays a scenario once per call: warm-up, some steps that are not timed, then those that are. Processes start
at the first play and are kept, asleep, until the variant is closed.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from izoo.algos.base import ACTION, MASK
from izoo.algos.ppo_config import PPOConfig
from izoo.algos.registry import make_algorithm
from izoo.benchmarks.stopwatch import CHUNK, seconds_per_step
from izoo.conf.train_options import CollectorConfig, TrainConfig, TrainingTwinConfig
from izoo.console import workers_ignore_interrupts
from izoo.contexts.context import Context
from izoo.contexts.procedural import procedural_context
from izoo.contexts.source import Schedule, episode_seed
from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.envs.config import ACTION_HIGH_MPS2
from izoo.envs.mdp.frame import TOTALS
from izoo.envs.twin_env import TwinEnv
from izoo.metrics.definitions import EPISODE_METRICS
from izoo.training.collectors import BatchSource, ShiftedSchedule

WARMUP_S = 350.0
"""Time in which the region fills, with nobody commanding."""
SAMPLE_STEPS = 20
"""Agents and vehicles are counted once in so many steps, so that counting takes next to no part of the time."""
AGENT_SLOTS = 96
VEHICLE_STEPS = EPISODE_METRICS.index("vehicle_steps")
_together: Any = None
"""In a process of :class:`BareSideBySide`: the barrier that all of them share."""


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


def make_variants(plan: Plan, twins: Sequence[tuple[int, int]] = ()) -> dict[str, Variant]:
    """Return every variant by the name of its row; the first is what the others are compared with.

    Args:
        plan: what is played.
        twins: environments and threads of each row of the twin; the last of them also with the compiled surrogate,
            with a policy, and with whole episodes and the resets between them (with either surrogate).
    """
    lean = plan.env(emit=())
    last = {threads: (envs, threads) for envs, threads in twins}.values()
    several = f"{plan.workers} {'worker' if plan.workers == 1 else 'workers'}"
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
        **{f"{_twin_label(*twin)}, with resets": OnTwinWithResets(plan, *twin) for twin in last},
        **{
            f"{_twin_label(*twin)}, compiled CO2, with resets": OnTwinWithResets(plan, *twin, "compiled")
            for twin in last
        },
    }


def _twin_label(envs: int, threads: int) -> str:
    return f"twin, {envs} {'environment' if envs == 1 else 'environments'}" + (
        f", {threads} threads" if threads > 1 else ""
    )


class Bare:
    """Libsumo alone, with nobody reading or commanding, in this process; one episode after the other."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self._counts: dict[int, tuple[float, float]] = {}

    def play(self, scenario: int) -> Sample:
        context, workers = self.plan.contexts[scenario], range(self.plan.workers)
        if scenario not in self._counts:
            self._counts[scenario] = _mean([_count(self.plan, context, worker) for worker in workers])
        vehicles, agents = self._counts[scenario]
        rate = statistics.harmonic_mean([_time_bare(self.plan, context, worker) for worker in workers])
        return Sample(rate, rate * agents, vehicles, agents)

    def close(self) -> None:
        pass


class BareSideBySide:
    """Libsumo alone in several processes that know nothing of each other: what the machine's cores allow.

    The rate is the sum of theirs. Collectors also wait for the episode with the most traffic.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        spawn = multiprocessing.get_context("spawn")
        together = spawn.Barrier(plan.workers, timeout=300.0)
        self._pool = ProcessPoolExecutor(plan.workers, spawn, initializer=_join, initargs=(together,))
        self._counts: dict[int, tuple[float, float]] = {}

    def play(self, scenario: int) -> Sample:
        workers = self.plan.workers
        tasks = [self.plan] * workers, [self.plan.contexts[scenario]] * workers, range(workers)
        if scenario not in self._counts:
            with workers_ignore_interrupts():
                self._counts[scenario] = _mean(list(self._pool.map(_count, *tasks)))
        vehicles, agents = self._counts[scenario]
        rate = sum(self._pool.map(_time_bare_together, *tasks))
        return Sample(rate, rate * agents, vehicles, agents)

    def close(self) -> None:
        self._pool.shutdown(cancel_futures=True)


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
        agents, vehicle_steps, begin = 0, 0.0, time.perf_counter()
        for _ in range(self.plan.batches):
            batch = source.next()
            agents += int(batch["agents", "mask"].sum())
            counted = batch["next", TOTALS][..., VEHICLE_STEPS]
            vehicle_steps += float((counted[:, -1] - counted[:, 0]).sum())
        elapsed = time.perf_counter() - begin
        source.next()  # the episodes end in it
        steps = self.plan.batches * CHUNK * self._envs
        vehicles = vehicle_steps / (self.plan.batches * (CHUNK - 1) * self._envs)
        return Sample(steps / elapsed, agents / elapsed, vehicles, agents / steps)

    def _start(self, schedule: Schedule) -> BatchSource:
        options = TrainConfig(
            algo=PPOConfig(frames_per_batch=self._envs * CHUNK),
            collector=CollectorConfig(name=self.collector),
            env=self.plan.env(emit=()),
            num_workers=self.plan.workers,
        )
        torch.manual_seed(0)
        policy = self.policy or make_algorithm(options.algo, options.action, options.env).policy
        return BatchSource(options, policy, schedule)

    def close(self) -> None:
        if self._source is not None:
            self._source.close()


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


RESET_EPISODES = 2


@dataclass
class OnTwinWithResets:
    """Whole episodes of the default length on the twin, with the resets between them; CVs accelerate fully.

    Args:
        plan: whose contexts are played.
        envs, threads: of the twin.
        surrogate: what computes CO2.
    """

    plan: Plan
    envs: int
    threads: int
    surrogate: Literal["torch", "compiled"] = "torch"

    def play(self, scenario: int) -> Sample:
        """Time the episodes after the first reset up to the last one's end."""
        config, context = EnvConfig(emit=(), num_agents=AGENT_SLOTS), self.plan.contexts[scenario]
        action = torch.full((self.envs, config.num_agents, 1), ACTION_HIGH_MPS2)
        agents = vehicle_steps = before = 0.0
        steps = 0
        made = TwinEnv(self.envs, context, config=config, threads=self.threads, surrogate=self.surrogate)
        with contextlib.closing(made) as env:
            state = env.reset()
            totals = env.frames["episode_metrics"]
            begin = time.perf_counter()
            for _ in range(RESET_EPISODES * config.control_steps):
                state.set(ACTION, action)
                _, state = env.step_and_maybe_reset(state)
                if steps % SAMPLE_STEPS == 0:
                    agents += SAMPLE_STEPS * float(env.frames["mask"].sum())
                seen = float(totals[:, VEHICLE_STEPS].sum())
                vehicle_steps += before if seen < before else 0.0  # all episodes have ended, and others begun
                before, steps = seen, steps + 1
            elapsed = time.perf_counter() - begin
        played = steps * self.envs
        return Sample(played / elapsed, agents / elapsed, vehicle_steps / played, agents / played)

    def close(self) -> None:
        pass


@contextlib.contextmanager
def _simulation(plan: Plan, context: Context, worker: int) -> Iterator[Any]:
    """A simulator of this process, after its warm-up."""
    with contextlib.closing(
        EcoDrivingEnv(context, config=plan.env(emit=()), worker=worker, num_workers=plan.workers)
    ) as env:
        env.reset(context=context, seed=episode_seed(0, worker))
        yield env.backend


def _count(plan: Plan, context: Context, worker: int) -> tuple[float, float]:
    """Return the mean vehicles and CVs of the timed steps where nobody commands."""
    vehicles = agents = 0
    with _simulation(plan, context, worker) as simulator:
        simulator.frame["defer"][:] = 1
        for step in range(CHUNK + plan.steps):
            simulator.step()
            if step >= CHUNK:
                vehicles += len(simulator.names.members)
                agents += int(simulator.frame["mask"].sum())
    return vehicles / plan.steps, agents / plan.steps


def _time_bare(plan: Plan, context: Context, worker: int, wait: Callable[[], object] = lambda: None) -> float:
    with _simulation(plan, context, worker) as simulator:
        return 1.0 / seconds_per_step(simulator.session.advance, plan.steps, CHUNK, wait)


def _mean(counts: list[tuple[float, float]]) -> tuple[float, float]:
    vehicles, agents = np.mean(counts, axis=0).tolist()
    return vehicles, agents


def _in_turn(samples: Sequence[Sample]) -> Sample:
    """Return the rates and means of episodes of the same number of steps that were played one after the other."""
    env_steps, _, vehicles, agents = zip(*samples, strict=True)
    rate = statistics.harmonic_mean(env_steps)
    return Sample(rate, rate * statistics.mean(agents), statistics.mean(vehicles), statistics.mean(agents))


def _join(together: Any) -> None:
    global _together
    _together = together


def _time_bare_together(plan: Plan, context: Context, worker: int) -> float:
    """As :func:`_time_bare`, but the timed steps begin when all processes have come so far."""
    try:
        return _time_bare(plan, context, worker, _together.wait)
    except BaseException:
        _together.abort()
        raise


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
