"""Builds the nets of a sample of intersections, and plays two short episodes in each."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.progress import track

from izoo.algos.drivers.by_name import make_driver
from izoo.contexts.cities import rebuilt as cities
from izoo.contexts.context import Context
from izoo.contexts.spec import IntersectionSpec
from izoo.envs.config import EnvConfig
from izoo.envs.env import EcoDrivingEnv
from izoo.errors import IzooError, check_range
from izoo.networks.dataset.intersections import load_specs
from izoo.networks.net.build import TOGETHER, build_nets
from izoo.results.playing import Policy, run_episode

PER_CITY = 10


@dataclass
class SmokeTestReport:
    """What was found: failures by the name of the context."""

    intersections: int = 0
    episodes: int = 0
    crossed: float = 0.0
    gridlocked: int = 0
    failures: dict[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        lines = [
            f"{self.intersections} intersections, {self.episodes} episodes, {len(self.failures)} failures; "
            f"{self.crossed:.0f} vehicles crossed, {self.gridlocked} episodes in gridlock"
        ]
        return "\n".join([*lines, *(f"  failed: {name}: {reason}" for name, reason in self.failures.items())])


def choose(path: Path | None, names: Sequence[str] | None, count: int | None, seed: int) -> list[IntersectionSpec]:
    """Draw intersections from a folder, or evenly from cities.

    Args:
        path: a folder of intersections; ``None`` means the built-in cities.
        names: cities; ``None`` means all ten.
        count: how many in all; ``None`` means 10 per city, or all of ``path``.
        seed: of the draw.
    """
    if count is not None:
        check_range("--count", count, 1, 10**6)
    check_range("--seed", seed, 0, 2**31 - 1)
    generator = np.random.default_rng(seed)
    if path is not None:
        specs = load_specs(path)
        chosen = generator.choice(len(specs), min(count or len(specs), len(specs)), replace=False)
        return [specs[int(index)] for index in sorted(chosen)]
    chosen_cities = [
        cities.get(name) for name in dict.fromkeys(cities.city_name(name) for name in names or cities.CITIES)
    ]
    shares = np.full(len(chosen_cities), (count or PER_CITY * len(chosen_cities)) // len(chosen_cities))
    shares[: (count or 0) % len(chosen_cities)] += 1
    found = []
    for city, share in zip(chosen_cities, shares, strict=True):
        chosen = generator.choice(len(city), min(int(share), len(city)), replace=False)
        found += [city[int(index)] for index in sorted(chosen)]
    return found


def run(specs: Sequence[IntersectionSpec], horizon_s: float, seed: int, progress: bool = False) -> SmokeTestReport:
    """Build the nets, and play two episodes in each: demand from all approaches, and from one.

    A third of the vehicles are CVs that act at random. Failures are collected, not raised.
    """
    config = EnvConfig(horizon_s=horizon_s, emit=("metrics",))
    report = SmokeTestReport(intersections=len(specs))
    driver = make_driver("random", config)
    with contextlib.ExitStack() as stack:
        env = EcoDrivingEnv(config=config)
        stack.callback(env.close, raise_if_closed=False)
        for number, spec in enumerate(track(specs, "intersections", disable=not progress)):
            if number % TOGETHER == 0:
                with contextlib.suppress(IzooError):  # raised again where that net is played
                    build_nets(specs[number : number + TOGETHER])
            for context in _contexts(spec, number):
                _play(env, driver, context, seed, report)
    return report


def _contexts(spec: IntersectionSpec, number: int) -> list[Context]:
    everywhere = Context(spec)
    legs = everywhere.demand_approaches
    return [everywhere, *([Context(spec, approach=legs[number % len(legs)])] if legs else [])]


def _play(env: EcoDrivingEnv, driver: Policy, context: Context, seed: int, report: SmokeTestReport) -> None:
    report.episodes += 1
    try:
        rows = run_episode(env, driver, context, seed).rows
    except Exception as error:
        report.failures[context.name] = f"{type(error).__name__}: {error}"
        return
    numbers = [value for row in rows for value in row.values() if isinstance(value, float)]
    if any(math.isnan(value) for value in numbers):
        report.failures[context.name] = "a number that it reports is missing"
    report.crossed += sum(row["crossed"] for row in rows)
    report.gridlocked += int(bool(rows) and rows[0]["episode_gridlock"] > 0)
