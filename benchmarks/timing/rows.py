"""The rows of the speed benchmark: each builds something, times it, and says how fast it is."""

from __future__ import annotations

import concurrent.futures
import contextlib
import os
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from izoo.algos.learners.ppo import PPOConfig
from izoo.algos.learners.registry import make_algorithm
from izoo.benchmarks.timing.clocks import Timed, timed
from izoo.conf.train_options import TrainConfig, TrainingTwinConfig
from izoo.contexts.context import Context
from izoo.contexts.procedural import EASY, ProceduralSource, procedural_context
from izoo.contexts.source import episode_seed
from izoo.envs import EcoDrivingEnv, EnvConfig, TwinEnv
from izoo.envs.config import ACTION_HIGH_MPS2
from izoo.envs.mdp.frame import TOTALS
from izoo.envs.mdp.metric_sums import EPISODE_METRICS
from izoo.files import CACHE_ENV
from izoo.training.collectors import BatchSource
from izoo.training.learner import Learner, learner_device

GROUPS = ("vehicles", "signal", "context", "metrics")
VEHICLE_STEPS = EPISODE_METRICS.index("vehicle_steps")
SEEDS = 16
"""Episodes that are played; environments beyond that play the same again."""
FILLING_S, EPISODE_S = 150.0, 5000.0
"""The region fills before anything is timed, and no episode ends meanwhile."""
SETTLING_STEPS = 20


class Row(NamedTuple):
    """A line of the table; what was not measured is ``None``."""

    name: str
    env_steps_per_s: float
    agent_steps_per_s: float | None = None
    vehicles: float | None = None
    timed: Timed | None = None
    note: str = ""


def scenarios() -> dict[str, Context]:
    """Contexts by name, a third of the vehicles CVs, with some 30, 20, 60 and 190 vehicles in the controlled region."""
    roads = {"lane_count": 3, "phase_count": 2, "green_s": 30.0, "red_s": 24.0}
    return {
        "two_lanes": procedural_context(lane_count=2, phase_count=2, inflow_vph_per_lane=500.0),
        "light": procedural_context(lane_count=1, inflow_vph_per_lane=500.0, lane_length_m=350.0),
        "medium": procedural_context(**roads, inflow_vph_per_lane=430.0, lane_length_m=400.0),
        "heavy": procedural_context(**roads, inflow_vph_per_lane=330.0, lane_length_m=400.0, approach="all"),
    }


def settings(**options: Any) -> EnvConfig:
    """Return an environment that is full of traffic from the first step on."""
    return EnvConfig(**{"warmup_s": FILLING_S, "horizon_s": EPISODE_S, "num_agents": 96, **options})


class Seeds:
    """A schedule of the same few episodes of one context, over and over."""

    def __init__(self, context: Context) -> None:
        self.context = context

    def __call__(self, episode: int) -> tuple[Context, int]:
        return self.context, episode_seed(0, episode % SEEDS)


def bare_sumo(context: Context, seconds: float) -> Row:
    """Libsumo alone, with nobody reading or commanding."""
    with contextlib.closing(EcoDrivingEnv(Seeds(context), config=settings(emit=()))) as env:
        env.reset()
        session: Any = env.backend.session  # type: ignore[attr-defined]
        found = timed(session.advance, seconds)
    return Row("bare libsumo", 1.0 / found.wall_s, timed=found)


def one_on_sumo(context: Context, seconds: float) -> Row:
    """One environment on SUMO, stepped by hand, emitting all groups."""
    env = EcoDrivingEnv(Seeds(context), config=settings())
    with contextlib.closing(env):
        return _stepped("SUMO, one environment", env, env.reset(), seconds, None)


def workers_on_sumo(context: Context, seconds: float, collector: str, workers: int) -> Row:
    """Environments on SUMO in processes, batches collected as training does with an untrained PPO policy."""
    length = 100
    options: dict[str, Any] = {"collector": collector, "num_workers": workers}
    config = TrainConfig(
        algo=PPOConfig(frames_per_batch=workers * length), env=settings(emit=()), simulator="sumo", **options
    )
    name = f"SUMO, {workers} x {collector}"
    return _collected(name, config, context, workers, length, seconds)


def on_twin(context: Context, seconds: float, envs: int, threads: int, surrogate: str) -> list[Row]:
    """The twin's backend alone, without anything that TorchRL sees; stepped, emitting no groups; and emitting all.

    Every CV accelerates as fast as is safe.
    """
    name, rows = f"twin {envs} x {threads}", []
    for emit in ((), GROUPS):
        env = TwinEnv(envs, Seeds(context), config=settings(emit=emit), threads=threads, surrogate=surrogate)
        with contextlib.closing(env):
            state = env.reset()
            _prepared(env)
            if not emit:
                rows.append(_alone(f"{name}, backend", env, seconds))
                state = env.reset()
                _prepared(env)
            rows.append(_stepped(f"{name}, {'all' if emit else 'no'} groups", env, state, seconds, env.backend))
    return rows


def _prepared(env: TwinEnv) -> None:
    """Wait until the next episodes are prepared, which would take cores from what is timed."""
    concurrent.futures.wait([future for _, future in env.backend._ahead.values()])


def _alone(name: str, env: TwinEnv, seconds: float) -> Row:
    env.frames["action"][:] = ACTION_HIGH_MPS2
    played, env.backend.played = env.backend.played, None
    for _ in range(SETTLING_STEPS):
        env.backend.step()
    found = timed(env.backend.step, seconds, env.backend)
    env.backend.played = played
    return Row(name, env.backend.num_envs / found.wall_s, timed=found)


def with_policy(context: Context, seconds: float, envs: int, threads: int, surrogate: str) -> Row:
    """The twin, batches collected as training does with an untrained PPO policy."""
    length = 20
    name = f"twin {envs} x {threads}, policy"
    return _collected(name, _on_twin(envs, length, threads, surrogate), context, envs, length, seconds)


def training(context: Context, seconds: float, envs: int, threads: int, surrogate: str, device: str) -> Row:
    """Collection and updates of PPO, together."""
    length, cores = 32, torch.get_num_threads()
    config = _on_twin(envs, length, threads, surrogate)
    where = learner_device(device)
    learner = Learner(make_algorithm(config.algo, config.action, config.env, where), config, where)
    parts: dict[str, list[float]] = {"collect": [], "update": []}
    agents: list[float] = []
    with contextlib.closing(BatchSource(config, learner.policy, Seeds(context))) as source:
        source.next()
        _prepared(source.batched.env)  # type: ignore[union-attr]

        def once() -> None:
            begin = time.perf_counter()
            batch = source.next()
            collected = time.perf_counter()
            torch.set_num_threads(min(cores, 8))
            agents.append(float(batch["agents", "mask"].sum()))
            learner.update(batch, 0.0)
            torch.set_num_threads(cores)
            parts["collect"].append(collected - begin)
            parts["update"].append(time.perf_counter() - collected)

        found = timed(once, seconds)
    collect_s, update_s = (statistics.median(values[1:]) for values in parts.values())
    rate = envs * length / found.wall_s
    return Row(
        f"training {envs} x {threads}, {learner.device.type}",
        rate,
        statistics.mean(agents[1:]) / found.wall_s,
        note=f"collection {collect_s:.2f} s, update {update_s:.2f} s for a batch of {length} steps",
    )


def start(envs: int, threads: int, surrogate: str) -> Row:
    """The first reset of environments that all have other nets, none of which is in the cache.

    Their memory is measured when the next episode of each is prepared, too.
    """
    config = EnvConfig(emit=())
    with contextlib.closing(TwinEnv(1, EASY, config=config, surrogate=surrogate)) as warm:
        warm.reset()
    before = os.environ.get(CACHE_ENV)
    held_mb = _resident_mb()
    with tempfile.TemporaryDirectory() as folder:
        os.environ[CACHE_ENV] = folder
        try:
            env = TwinEnv(envs, ProceduralSource(), config=config, threads=threads, surrogate=surrogate)
            with contextlib.closing(env):
                begin = time.perf_counter()
                env.reset()
                took_s = time.perf_counter() - begin
                _prepared(env)
                each_mb = (_resident_mb() - held_mb) / envs
        finally:
            os.environ.pop(CACHE_ENV)
            os.environ.update({} if before is None else {CACHE_ENV: before})
    note = f"{took_s:.1f} s for {envs} new nets, {each_mb:.2f} MB for each environment"
    return Row(f"start {envs} x {threads}", envs / took_s, note=note)


def emissions(seconds: float, batch: int = 4096) -> list[Row]:
    """Rates of CO2 of random vehicles of all classes, on one core: evaluations/s."""
    from izoo.emissions.classes import CLASSES
    from izoo.emissions.kernel import emission_rate_kernel, load_weights
    from izoo.emissions.moves import MovesSurrogate

    draw = np.random.default_rng(0)
    states = [draw.uniform(*ends, batch).astype(np.float32) for ends in ((0.0, 20.0), (-4.5, 2.6), (-5.0, 5.0))]
    classes, weights, out = draw.integers(len(CLASSES), size=batch), load_weights(), np.empty(batch, np.float32)
    module, active = MovesSurrogate(weights), np.ones(batch, np.uint8)
    tensors = [torch.from_numpy(array) for array in (*states, classes)]

    def batched() -> None:
        with torch.no_grad():
            module(*tensors, 20.0, 46.0)

    def compiled() -> None:
        arrays: list[Any] = [*states, classes, active, 20.0, 46.0, weights, out]
        emission_rate_kernel(*arrays)

    calls: dict[str, Callable[[], None]] = {"torch": batched, "compiled": compiled}
    return [
        Row(f"CO2, {name}", 0.0, note=f"{batch / timed(call, seconds / 2).wall_s:,.0f} vehicles/s, {batch} at a time")
        for name, call in calls.items()
    ]


def _resident_mb() -> float:
    """Return the memory that this process holds; where the system does not say so, the most that it ever held."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def _on_twin(envs: int, length: int, threads: int, surrogate: str) -> TrainConfig:
    return TrainConfig(
        algo=PPOConfig(frames_per_batch=envs * length),
        env=settings(emit=()),
        simulator="twin",
        num_envs=envs,
        twin=TrainingTwinConfig(threads, surrogate, stagger=False),  # type: ignore[arg-type]
    )


def _stepped(name: str, env: Any, state: Any, seconds: float, backend: Any) -> Row:
    envs = max(env.batch_size.numel(), 1)
    action = torch.full((*env.batch_size, env.config.num_agents, 1), ACTION_HIGH_MPS2)
    agents: list[float] = []
    mask, counted = env.frames["mask"], env.frames["episode_metrics"][:, VEHICLE_STEPS]

    def step() -> None:
        nonlocal state
        state.set(("agents", "action"), action)
        _, state = env.step_and_maybe_reset(state)

    for _ in range(SETTLING_STEPS):
        step()
    agents.append(float(mask.sum()))
    before = float(counted.sum())
    found = timed(step, seconds, backend)
    agents.append(float(mask.sum()))
    vehicles = (float(counted.sum()) - before) / ((found.calls + 1) * envs)
    return Row(name, envs / found.wall_s, statistics.mean(agents) / found.wall_s, vehicles, found)


def _collected(name: str, config: TrainConfig, context: Context, envs: int, length: int, seconds: float) -> Row:
    policy = make_algorithm(config.algo, config.action, config.env).policy
    agents: list[float] = []
    with contextlib.closing(BatchSource(config, policy, Seeds(context))) as source:
        last: Any = None

        def batch() -> None:
            nonlocal last
            last = source.next()
            agents.append(float(last["agents", "mask"].sum()))

        batch()
        if source.batched is not None:
            _prepared(source.batched.env)
        found = timed(batch, seconds, source.batched.env.backend if source.batched else None)
        driven = last["next", TOTALS][..., VEHICLE_STEPS]
        vehicles = float((driven[:, -1] - driven[:, 0]).mean()) / (length - 1)
    of_step = Timed(found.calls * length, found.wall_s / length, found.serial_s / length, found.shared_s / length)
    return Row(name, envs / of_step.wall_s, statistics.mean(agents) / found.wall_s, vehicles, of_step)
