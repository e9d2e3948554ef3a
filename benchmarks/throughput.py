"""How fast environments run, beside bare libsumo on the same network, demand and machine.

``python -m izoo.benchmarks.throughput [--json] [--workers N] [--scenarios light,medium,heavy] [--steps N]``

Every row plays the same episode: same net, same arrivals; where there are several workers, the next episodes besides.
Bare libsumo is also run in several processes at once, which shows what the machine's cores allow. CVs are commanded to
accelerate at their limit, which SUMO's checks turn into driving as fast as is safe, so that commands are given in every
step and traffic stays close to that of the bare simulation; the vehicles that were in the region are printed with each
row. All rows of a scenario are measured in turn, several times, so that a machine whose speed drifts slows them alike;
medians are reported.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import statistics
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any, Literal

from izoo import cli
from izoo.metrics.definitions import EPISODE_METRICS

ROUNDS = 3
SETTLE_STEPS = 400
"""Steps before timing starts, in which the region fills."""
CHUNK = 200
"""Steps per environment in a collected batch."""
SAMPLE_STEPS = 20
"""Agents and vehicles are counted once in so many steps, so that counting takes next to no part of the time."""
AGENT_SLOTS = 96
VEHICLE_STEPS = EPISODE_METRICS.index("vehicle_steps")
_together: Any = None
"""In a process of :func:`_bare_side_by_side`: the barrier that all of them share."""


@dataclass(frozen=True)
class Row:
    """One measured variant of one scenario; rates are medians over the rounds."""

    scenario: str
    variant: str
    env_steps_per_s: float
    agent_steps_per_s: float
    ratio_to_bare: float
    vehicles: float
    agents: float


def scenarios() -> dict[str, Any]:
    """Contexts with about 20, 60 and 190 vehicles in the controlled region, a third of them CVs."""
    from izoo.contexts.procedural import procedural_context

    roads = {"lane_count": 3, "phase_count": 2, "green_s": 30.0, "red_s": 24.0}
    return {
        "light": procedural_context(lane_count=1, inflow_vph_per_lane=500.0, lane_length_m=350.0),
        "medium": procedural_context(**roads, inflow_vph_per_lane=430.0, lane_length_m=400.0),
        "heavy": procedural_context(**roads, inflow_vph_per_lane=330.0, lane_length_m=400.0, approach="all"),
    }


def measure_scenario(name: str, context: Any, workers: int, steps: int, say: Callable[[str], None]) -> list[Row]:
    """Measure all variants of one scenario in turn."""
    variants = _variants(context, workers)
    samples: dict[str, list[tuple[float, float, float, float]]] = {label: [] for label in variants}
    for _ in range(ROUNDS):
        for label, run in variants.items():
            say(f"{name}: {label}")
            samples[label].append(run(steps))
    bare = [rate for rate, *_ in samples["bare libsumo"]]
    rows = []
    for label, values in samples.items():
        rate, agent_rate, vehicles, agents = (statistics.median(column) for column in zip(*values, strict=True))
        ratio = statistics.median(value[0] / base for value, base in zip(values, bare, strict=True))
        rows.append(Row(name, label, rate, agent_rate, ratio, vehicles, agents))
    return rows


Sample = tuple[float, float, float, float]
"""Environment steps/s, agent steps/s, mean vehicles in the region, mean CVs with a slot."""


def _variants(context: Any, workers: int) -> dict[str, Callable[[float], Sample]]:
    from izoo.envs import EcoDrivingEnv, EnvConfig, SumoParallelEnv

    lean = EnvConfig(emit=(), num_agents=AGENT_SLOTS)
    full = EnvConfig(num_agents=AGENT_SLOTS)
    return {
        "bare libsumo": lambda steps: _bare(context, steps),
        f"{workers} processes, bare libsumo": lambda steps: _bare_side_by_side(context, workers, steps),
        "one environment": lambda steps: _stepped(EcoDrivingEnv(context, config=lean), steps),
        "one environment, all groups emitted": lambda steps: _stepped(EcoDrivingEnv(context, config=full), steps),
        f"{workers} workers": lambda steps: _stepped(SumoParallelEnv(workers, context, config=lean), steps),
        f"{workers} workers, PPO policy": lambda steps: _collected("parallel", context, lean, workers, steps),
        f"{workers} processes, PPO policy": lambda steps: _collected("multisync", context, lean, workers, steps),
    }


def _bare(context: Any, steps: int, episode: int = 0, wait: Callable[[], object] = lambda: None) -> Sample:
    """Step libsumo alone, with nobody reading or commanding; count vehicles in a second, untimed pass."""
    from izoo.contexts.source import episode_seed
    from izoo.envs import EcoDrivingEnv, EnvConfig

    env = EcoDrivingEnv(context, config=EnvConfig(emit=(), num_agents=AGENT_SLOTS))
    try:
        env.reset(context=context, seed=episode_seed(0, episode))
        rate = _time_steps(env.simulator.session.advance, steps, wait)
        env.reset(context=context, seed=episode_seed(0, episode))
        simulator, vehicles, agents = env.simulator, 0, 0
        simulator.frame["defer"][:] = 1
        for step in range(SETTLE_STEPS + steps):
            simulator.step()
            if step >= SETTLE_STEPS:
                vehicles += len(simulator.rows)
                agents += int(simulator.frame["mask"].sum())
    finally:
        env.close()
    return rate, rate * agents / steps, vehicles / steps, agents / steps


def _bare_side_by_side(context: Any, workers: int, steps: int) -> Sample:
    """Step libsumo alone in several processes that know nothing of each other: what the machine's cores allow."""
    spawn = multiprocessing.get_context("spawn")
    together = spawn.Barrier(workers, timeout=300.0)
    with ProcessPoolExecutor(workers, spawn, initializer=_join, initargs=(together,)) as pool:
        samples = list(pool.map(_bare_together, [context] * workers, [steps] * workers, range(workers)))
    rate, agent_rate, vehicles, agents = (sum(column) for column in zip(*samples, strict=True))
    return rate, agent_rate, vehicles / workers, agents / workers


def _join(together: Any) -> None:
    global _together
    _together = together


def _bare_together(context: Any, steps: int, episode: int) -> Sample:
    """As :func:`_bare`, but its timed steps begin when all processes have come so far."""
    try:
        return _bare(context, steps, episode, _together.wait)
    except BaseException:
        _together.abort()
        raise


def _time_steps(step: Callable[[], None], count: int, wait: Callable[[], object] = lambda: None) -> float:
    """Call ``step`` ``count`` times, after the region has filled and ``wait`` is over; return calls per second."""
    for _ in range(SETTLE_STEPS):
        step()
    wait()
    begin = time.perf_counter()
    for _ in range(count):
        step()
    return count / (time.perf_counter() - begin)


def _stepped(env: Any, steps: int) -> Sample:
    """Step an environment whose CVs all accelerate as hard as they may."""
    import numpy as np
    import torch

    num = env.batch_size.numel()
    try:
        state = env.reset()
        action = torch.full((*env.batch_size, env.config.num_agents, 1), env.action_spec["agents", "action"].high.max())
        totals, mask = env.frames["episode_metrics"], env.frames["mask"]
        taken, vehicle_steps = 0, []
        agents_seen = []

        def step() -> None:
            nonlocal state, taken
            if taken % SAMPLE_STEPS == 0 and taken >= SETTLE_STEPS:
                agents_seen.append(mask.sum() / num)
                vehicle_steps.append(totals[:, VEHICLE_STEPS].sum() / num)
            state.set(("agents", "action"), action)
            _, state = env.step_and_maybe_reset(state)
            taken += 1

        rate = _time_steps(step, steps)
        agents = float(statistics.fmean(agents_seen))
        grown = np.diff(vehicle_steps)  # the count begins anew with an episode
        vehicles = float(grown[grown >= 0].mean()) / SAMPLE_STEPS
    finally:
        env.close()
    return rate * num, rate * num * agents, vehicles, agents


def _collected(
    collector: Literal["parallel", "multisync"], context: Any, config: Any, workers: int, steps: int
) -> Sample:
    """Collect batches with a freshly initialised PPO policy, as training does."""
    import torch

    from izoo.algos.ppo_config import PPOConfig
    from izoo.conf.options import CollectorConfig, TrainConfig
    from izoo.contexts.source import as_schedule
    from izoo.envs.layout import observation_names
    from izoo.training.collectors import BatchSource
    from izoo.training.runs import make_algorithm

    frames = workers * CHUNK
    options = TrainConfig(
        algo=PPOConfig(frames_per_batch=frames),
        collector=CollectorConfig(name=collector),
        env=config,
        num_workers=workers,
    )
    torch.manual_seed(0)
    learner = make_algorithm(options, len(observation_names(config)))
    source = BatchSource(options, learner.policy, as_schedule(context, 0))
    try:
        for _ in range(-(-SETTLE_STEPS * workers // frames)):
            source.next()
        agents, batches, begin = 0, steps // CHUNK, time.perf_counter()
        for _ in range(batches):
            agents += int(source.next()["agents", "mask"].sum())
        elapsed = time.perf_counter() - begin
    finally:
        source.close()
    total = batches * frames
    return total / elapsed, agents / elapsed, float("nan"), agents / total


def print_table(rows: list[Row]) -> None:
    """Print the rows for people."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title="environment steps per second, and the ratio to bare libsumo (medians)")
    for heading in ("scenario", "variant", "env steps/s", "agent steps/s", "ratio", "vehicles", "CVs"):
        table.add_column(heading, justify="left" if heading in ("scenario", "variant") else "right")
    for row in rows:
        vehicles = "" if row.vehicles != row.vehicles else f"{row.vehicles:.0f}"
        table.add_row(
            row.scenario,
            row.variant,
            f"{row.env_steps_per_s:,.0f}",
            f"{row.agent_steps_per_s:,.0f}",
            f"{row.ratio_to_bare:.2f}",
            vehicles,
            f"{row.agents:.0f}",
            end_section=row is rows[-1],
        )
    Console().print(table)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def main(argv: list[str] | None = None) -> int:
    """Run the benchmark; returns the exit code."""
    parser = argparse.ArgumentParser("python -m izoo.benchmarks.throughput", description=__doc__.split("\n")[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.add_argument("--workers", type=int, default=2, help="worker processes (default 2)")
    parser.add_argument("--steps", type=int, default=1000, help="timed steps per row and round (default 1000)")
    parser.add_argument("--scenarios", default="light,medium,heavy", help="comma-separated (default all three)")
    options = parser.parse_args(argv)
    known = ("light", "medium", "heavy")
    chosen = options.scenarios.split(",")
    for name in chosen:
        if name not in known:
            parser.error(f"unknown scenario {name!r}; choose from: {', '.join(known)}")
    if options.workers < 1:
        parser.error(f"--workers is {options.workers}; one or more are needed")
    if options.steps < CHUNK:
        parser.error(f"--steps is {options.steps}; it must be {CHUNK} or more: collectors are timed in batches of that")
    print("izoo throughput: loading torch and SUMO", file=sys.stderr, flush=True)
    import torch

    torch.set_num_threads(1)
    contexts = scenarios()
    rows = []
    for name in chosen:
        rows += measure_scenario(name, contexts[name], options.workers, options.steps, _say)
    if options.json:
        print(json.dumps({"workers": options.workers, "rows": [asdict(row) for row in rows]}, indent=1))
    else:
        print_table(rows)
    return 0


if __name__ == "__main__":
    sys.exit(cli.exit_code("benchmarks.throughput", main))
