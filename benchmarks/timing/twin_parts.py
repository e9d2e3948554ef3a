"""What a step of the twin costs, and where it goes: used by the scaling benchmark."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from izoo.benchmarks.timing.stopwatch import clocked, seconds_per_step
from izoo.envs.mdp.metric_sums import EPISODE_METRICS

PARTS = {"drive": "driving", "emit": "CO2", "conclude": "MDP", "play": "all three"}
"""Parts of a step and their headings: orders, driving and where vehicles are then; the surrogate, with what it needs
and returns; accounting, rewards and observations. With the compiled surrogate one call does all three."""
_CALLS = {"drive_all": "drive", "conclude_all": "conclude", "play_all": "play"}


@contextlib.contextmanager
def clocks_around(backend: Any) -> Iterator[dict[str, float]]:
    """Put clocks around the parts of a backend's steps; seconds add up in the dictionary. For one thread."""
    from izoo.envs.twin import backend

    seconds = dict.fromkeys(PARTS, 0.0)

    before = {name: getattr(backend, name) for name in _CALLS}
    emitters = backend._emitters
    try:
        for name, part in _CALLS.items():
            setattr(backend, name, clocked(before[name], seconds, part))
        for emitter in emitters:
            emitter.emit = clocked(emitter.emit, seconds, "emit")
        yield seconds
    finally:
        for name, call in before.items():
            setattr(backend, name, call)
        for emitter in emitters:
            del emitter.emit


def measure(
    context: Any, num_envs: int, steps: int, settle: int, threads: int = 1, surrogate: str = "torch"
) -> dict[str, float]:
    """Return vehicles, microseconds per environment step, whole and (with one thread) by part, and kilobytes.

    Args:
        context: what all environments play, each with another seed.
        num_envs: environments; everybody commanded accelerates as fast as is safe.
        steps, settle: timed steps, and those before.
        threads, surrogate: of the twin.
    """
    import torch

    from izoo.envs import EnvConfig
    from izoo.envs.config import ACTION_HIGH_MPS2
    from izoo.envs.twin_env import TwinEnv

    config = EnvConfig(emit=(), num_agents=256, num_vehicles=1024)
    config = replace(config, horizon_s=config.warmup_s + (steps + settle + 2) * config.step_s)
    with contextlib.closing(TwinEnv(num_envs, context, config=config, threads=threads, surrogate=surrogate)) as env:
        state = env.reset()
        env.backend.forget_ahead()  # nothing shall run beside what is timed
        action = torch.full((num_envs, config.num_agents, 1), ACTION_HIGH_MPS2)
        counted = env.frames["episode_metrics"][:, EPISODE_METRICS.index("vehicle_steps")]

        def step() -> None:
            nonlocal state
            state.set(("agents", "action"), action)
            _, state = env.step_and_maybe_reset(state)

        clocks: contextlib.AbstractContextManager[dict[str, float]] = contextlib.nullcontext({})
        if threads == 1:
            clocks = clocks_around(env.backend)
        with clocks as seconds:
            for _ in range(settle):
                step()
            seconds.update(dict.fromkeys(seconds, 0.0))
            before = float(counted.mean())
            whole = seconds_per_step(step, steps, 0)
        return {
            "environments": float(num_envs),
            "vehicles": (float(counted.mean()) - before) / steps,
            "whole_us": 1e6 * whole / num_envs,
            **{f"{part}_us": 1e6 * spent / (steps * num_envs) for part, spent in seconds.items() if spent > 0.0},
            "kilobytes": _kilobytes(env.backend),
        }


def print_table(title: str, rows: Sequence[Mapping[str, float]]) -> None:
    """Print rows of :func:`measure`."""
    from izoo.report.tables import Table

    columns = {"environments": "envs", "vehicles": "vehicles", "whole_us": "twin"}
    columns |= {f"{part}_us": heading for part, heading in PARTS.items()} | {"kilobytes": "kB each"}
    shown = [name for name in columns if any(name in row for row in rows)]
    lines = [[f"{row[name]:,.1f}" if name.endswith("_us") else f"{row[name]:,.0f}" for name in shown] for row in rows]
    Table.of(title, [columns[name] for name in shown], lines).show()


def _kilobytes(backend: Any) -> float:
    """Return what the tables of the first environment take: driving, demand, and the MDP; working memory is shared."""
    from izoo.envs.twin.runtime.layout import WORKING

    run = backend._runs[0]
    state = (array for name, array in run.driving.state._asdict().items() if name not in WORKING)
    return sum(array.nbytes for array in (*state, *run.driving.traffic, *run.episode.tables)) / 1e3
