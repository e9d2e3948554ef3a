"""How an environment's step grows with traffic, where its time goes, and what a reset costs.

``python -m izoo.benchmarks.scaling`` steps one environment on procedural intersections from a handful to some
hundreds of vehicles in the controlled region, beside bare libsumo, and times each part of a step and a reset to a
cached net, warm-up included. With ``simulator=twin`` it steps many environments on the twin instead, and then one of
the intersections with growing numbers of environments.
"""

from __future__ import annotations

import dataclasses
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from izoo.benchmarks.timing.stopwatch import clocked, seconds_per_step
from izoo.cli.option_command import OptionCommand
from izoo.console import counted
from izoo.errors import check_range

if TYPE_CHECKING:
    from izoo.envs import EnvConfig

SETTLE_STEPS = 400
RESETS = 7
PARTS = ("advance", "read", "command_speeds")
"""Of a step in SUMO: methods of its session."""
MIDDLE, MANY_STEPS = 3, 50
"""The world with some 60 vehicles, and the timed steps of the largest number of environments."""


@dataclasses.dataclass(frozen=True)
class ScalingConfig:
    """Options of the scaling benchmark.

    Attributes:
        steps: timed steps per world.
        simulator: ``sumo`` or ``twin``.
        num_envs: environments on the twin in each world.
        counts: numbers of environments on the twin in one of the worlds, that with some 60 vehicles.
        threads: of the twin.
        surrogate: of the twin: ``torch``, ``cuda`` or ``compiled``.
    """

    steps: int = 800
    simulator: Literal["sumo", "twin"] = "sumo"
    num_envs: int = 16
    counts: tuple[int, ...] = (1, 4, 16, 64, 256, 1024)
    threads: int = 1
    surrogate: Literal["torch", "cuda", "compiled"] = "torch"

    def __post_init__(self) -> None:
        check_range("steps", self.steps, 1, 10**5)
        check_range("threads", self.threads, 1, 1024)
        for count in (self.num_envs, *self.counts):
            check_range("num_envs and counts", count, 1, 65536)


def worlds() -> list[Any]:
    """Contexts of growing traffic, all approaches, a third of the vehicles CVs."""
    from izoo.contexts.procedural import procedural_context

    flows = [(1, 100.0), (1, 150.0), (1, 300.0), (2, 250.0), (2, 350.0), (3, 330.0), (4, 330.0), (4, 420.0)]
    sizes = [*((*flow, 400.0) for flow in flows), (4, 500.0, 600.0)]
    return [
        procedural_context(
            lane_count=lanes,
            phase_count=min(lanes, 2),
            inflow_vph_per_lane=inflow,
            lane_length_m=length_m,
            green_s=30.0,
            red_s=30.0,
            approach="all",
        )
        for lanes, inflow, length_m in sizes
    ]


def settings(steps: int) -> EnvConfig:
    """Return an environment whose vehicles keep coming, and whose episode lasts, until ``steps`` are timed."""
    from izoo.envs import EnvConfig

    config = EnvConfig(emit=(), num_agents=256, num_vehicles=1024)
    return dataclasses.replace(config, horizon_s=config.warmup_s + (SETTLE_STEPS + steps + 2) * config.step_s)


def measure(context: Any, steps: int) -> dict[str, float]:
    """Return vehicles, microseconds per step (bare, environment, and its parts), and milliseconds per reset."""
    import torch

    from izoo.envs import EcoDrivingEnv

    env = EcoDrivingEnv(context, config=settings(steps))
    try:
        env.reset()
        simulator: Any = env.backend
        resets = []
        for _ in range(RESETS):
            begin = time.perf_counter()
            state = env.reset()
            resets.append(time.perf_counter() - begin)
        bare = 1e6 * seconds_per_step(simulator.session.advance, steps, SETTLE_STEPS)
        state = env.reset()
        action = torch.full((256, 1), 2.6)
        vehicles: list[int] = []

        def step() -> None:
            nonlocal state
            state.set(("agents", "action"), action)
            _, state = env.step_and_maybe_reset(state)
            vehicles.append(len(simulator.ids.members))

        seconds = dict.fromkeys(PARTS, 0.0)
        for name in PARTS:
            setattr(simulator.session, name, clocked(getattr(simulator.session, name), seconds, name))
        whole = 1e6 * seconds_per_step(step, steps, SETTLE_STEPS, lambda: seconds.update(dict.fromkeys(PARTS, 0.0)))
        return {
            "vehicles": float(np.mean(vehicles[SETTLE_STEPS:])),
            "bare_us": bare,
            "environment_us": whole,
            **{f"{name}_us": 1e6 * spent / steps for name, spent in seconds.items()},
            "reset_ms": 1e3 * statistics.median(resets),
        }
    finally:
        env.close()


def run_twin(config: ScalingConfig) -> None:
    """Measure the twin: every world, then growing numbers of environments in one of them."""
    from izoo.benchmarks.timing import twin_parts

    contexts, on = worlds(), (config.threads, config.surrogate)
    by_world: list[dict[str, float]] = []
    by_count: list[dict[str, float]] = []
    for number, context in enumerate(contexts, 1):
        print(f"world {number} of {len(contexts)}", file=sys.stderr, flush=True)
        by_world.append(twin_parts.measure(context, config.num_envs, config.steps, SETTLE_STEPS, *on))
    for count in config.counts:
        print(f"{count} environments", file=sys.stderr, flush=True)
        steps = max(config.steps // count, MANY_STEPS)
        by_count.append(twin_parts.measure(contexts[MIDDLE], count, steps, SETTLE_STEPS, *on))
    about = f"surrogate {config.surrogate}, {counted(config.threads, 'thread')}"
    twin_parts.print_table(f"the twin, us per environment step, {about}", by_world)
    twin_parts.print_table(f"the twin by number of environments, {about}", by_count)
    print_growth(by_world, "whole_us")


def print_growth(rows: Sequence[Mapping[str, float]], column: str) -> None:
    """Print how a time grows with the vehicles, by least squares."""
    slope, fixed = np.polyfit([row["vehicles"] for row in rows], [row[column] for row in rows], 1)
    print(f"least squares: {fixed:.0f} us + {slope:.2f} us per vehicle")


def run(config: ScalingConfig, given: frozenset[str] = frozenset()) -> None:
    """Measure every world, and print the table."""
    print("Loading torch and SUMO.", flush=True)
    import torch

    from izoo.report.tables import Table

    torch.set_num_threads(1)
    if config.simulator == "twin":
        run_twin(config)
        return
    contexts, rows = worlds(), []
    for number, context in enumerate(contexts, 1):
        print(f"world {number} of {len(contexts)}", file=sys.stderr, flush=True)
        rows.append(measure(context, config.steps))
    columns = "vehicles", "bare libsumo", "environment", "SUMO's step", "reading", "commands", "rest", "reset ms"
    lines = []
    for row in rows:
        parts = [row[f"{name}_us"] for name in PARTS]
        cells = row["vehicles"], row["bare_us"], row["environment_us"], *parts, row["environment_us"] - sum(parts)
        lines.append([f"{cell:.0f}" for cell in (*cells, row["reset_ms"])])
    Table.of("one environment: microseconds per step", columns, lines).show()
    print_growth(rows, "environment_us")


COMMAND = OptionCommand(
    name="benchmarks.scaling",
    summary="Measure how an environment's step grows with traffic, where its time goes, and what a reset costs.",
    examples=("izoo.benchmarks.scaling", "izoo.benchmarks.scaling simulator=twin steps=400"),
    config="izoo.benchmarks.scaling:ScalingConfig",
    work="izoo.benchmarks.scaling:run",
)
main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
