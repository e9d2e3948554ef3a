"""Builds the nets of a sample of intersections, plays a short episode in each, and measures how long building takes."""

from __future__ import annotations

import contextlib
import math
import os
import statistics
import tempfile
import time
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
from izoo.files import CACHE_ENV
from izoo.networks.dataset.intersections import load_specs
from izoo.networks.net.build import TOGETHER, build_net, build_nets
from izoo.networks.road import read_road
from izoo.results.playing import run_episode

PER_CITY = 10


@dataclass
class SmokeTestReport:
    """What was found; times are in s: to build all nets, of each lookup and reading, and of each episode."""

    intersections: int = 0
    episodes: int = 0
    crossed: float = 0.0
    gridlocked: int = 0
    failures: dict[str, str] = field(default_factory=dict)
    build_s: float = 0.0
    lookup_s: list[float] = field(default_factory=list)
    read_s: list[float] = field(default_factory=list)
    episode_s: list[float] = field(default_factory=list)

    def __str__(self) -> str:
        lines = [
            f"{self.intersections} intersections, {self.episodes} episodes, {len(self.failures)} failures; "
            f"{self.crossed:.0f} vehicles crossed, {self.gridlocked} episodes in gridlock",
            f"  nets built in {self.build_s:.2f} s",
        ]
        for name, times in (
            ("net found in the cache", self.lookup_s),
            ("net read", self.read_s),
            ("episode played", self.episode_s),
        ):
            if times:
                lines.append(
                    f"  {name}: median {1e3 * statistics.median(times):.1f} ms, longest {1e3 * max(times):.1f} ms"
                )
        lines += [f"  failed: {name}: {reason}" for name, reason in self.failures.items()]
        return "\n".join(lines)


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
    """Build the nets in an empty cache, and play two episodes in each: demand from all approaches, and from one.

    A third of the vehicles are CVs that act at random. Failures are collected, not raised.
    """
    config = EnvConfig(horizon_s=horizon_s, emit=("metrics",))
    report = SmokeTestReport(intersections=len(specs))
    driver = make_driver("random", config)
    before = os.environ.get(CACHE_ENV)
    env = EcoDrivingEnv(config=config)
    with tempfile.TemporaryDirectory(prefix="izoo-smoke-test-") as folder:
        os.environ[CACHE_ENV] = folder
        try:
            for number, spec in enumerate(track(specs, "intersections", disable=not progress)):
                if number % TOGETHER == 0:
                    _build(specs[number : number + TOGETHER], report)
                if _time_net(spec, report):
                    for context in _contexts(spec, number):
                        _play(env, driver, context, seed, report)
        finally:
            env.close(raise_if_closed=False)
            if before is None:
                del os.environ[CACHE_ENV]
            else:
                os.environ[CACHE_ENV] = before
    return report


def _contexts(spec: IntersectionSpec, number: int) -> list[Context]:
    everywhere = Context(spec)
    legs = everywhere.demand_approaches
    return [everywhere, *([Context(spec, approach=legs[number % len(legs)])] if legs else [])]


def _build(specs: Sequence[IntersectionSpec], report: SmokeTestReport) -> None:
    start = time.perf_counter()
    with contextlib.suppress(IzooError):  # raised again where that net is looked up
        build_nets(specs)
    report.build_s += time.perf_counter() - start


def _time_net(spec: IntersectionSpec, report: SmokeTestReport) -> bool:
    """Look up and read a net; say whether that worked."""
    try:
        times = [time.perf_counter()]
        net = build_net(spec)
        times.append(time.perf_counter())
        read_road(net)
        times.append(time.perf_counter())
    except IzooError as error:
        report.failures[spec.name] = str(error)
        return False
    report.read_s.append(times[2] - times[1])
    if spec.net_path is None:
        report.lookup_s.append(times[1] - times[0])
    return True


def _play(env: EcoDrivingEnv, driver: object, context: Context, seed: int, report: SmokeTestReport) -> None:
    report.episodes += 1
    start = time.perf_counter()
    try:
        rows = run_episode(env, driver, context, seed).rows  # type: ignore[arg-type]
    except Exception as error:
        report.failures[context.name] = f"{type(error).__name__}: {error}"
        return
    report.episode_s.append(time.perf_counter() - start)
    numbers = [value for row in rows for value in row.values() if isinstance(value, float)]
    if any(math.isnan(value) for value in numbers):
        report.failures[context.name] = "a number that it reports is missing"
    report.crossed += sum(row["crossed"] for row in rows)
    report.gridlocked += int(bool(rows) and rows[0]["episode_gridlock"] > 0)
