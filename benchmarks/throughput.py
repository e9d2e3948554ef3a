"""How fast environments run, beside bare libsumo on the same network, demand and machine.

``python -m izoo.benchmarks.throughput workers=2 scenarios=[light,medium,heavy] steps=400``

Rows of the twin hold many environments in this process, in one or several threads; they play the same episodes over
and over, and are collected in shorter batches the more there are of them.

Every row plays the same episodes, as many as there are workers: same nets, same arrivals; one after the other where
there is one environment, side by side where there are several. Bare libsumo is also run in several processes at once,
which shows what the machine's cores allow. Environments are timed as training collects from them: one in this process,
workers that step together (``collector=parallel``), processes that each go at their own pace within a batch
(``collector=multisync``); rows named ``step()`` step by hand. Without a policy CVs are commanded to accelerate at their
limit, which SUMO's checks turn into driving as fast as is safe, so that commands are given in every step and traffic
stays close to that of the bare simulation; the vehicles that were in the region are printed with each row.
All rows of a scenario are measured in turn, several times, so that a machine whose speed drifts slows them alike;
medians are reported.
"""

from __future__ import annotations

import contextlib
import itertools
import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from izoo.benchmarks.timing.stopwatch import CHUNK
from izoo.cli.option_command import OptionCommand
from izoo.console import Progress
from izoo.errors import IzooError, check_range

if TYPE_CHECKING:
    from izoo.benchmarks.timing.throughput_plan import Sample

ROUNDS = 3
Scenario = Literal["light", "medium", "heavy"]


@dataclass(frozen=True)
class ThroughputConfig:
    """Options of the throughput benchmark.

    Attributes:
        scenarios: of ``light``, ``medium`` and ``heavy`` traffic.
        workers: processes of the variants that have several.
        steps: timed steps per environment, variant and round; a multiple of 200, as collectors are timed in such
            batches.
        twin_envs: environments on the twin, a row for each number; the last also with compiled CO2 and with a policy;
            empty: no such rows.
        twin_threads: threads of the twin, rows for each number.
    """

    scenarios: tuple[Scenario, ...] = ("light", "medium", "heavy")
    workers: int = 2
    steps: int = 400
    twin_envs: tuple[int, ...] = (1, 16, 256, 128)
    twin_threads: tuple[int, ...] = (1, 2)

    def __post_init__(self) -> None:
        check_range("workers", self.workers, 1, 1024)
        for count in self.twin_envs:
            check_range("twin_envs", count, 1, 65536)
        for count in self.twin_threads:
            check_range("twin_threads", count, 1, 1024)
        if self.steps < CHUNK or self.steps % CHUNK:
            raise IzooError(f"steps is {self.steps}; it must be a multiple of {CHUNK}, a batch of the collectors.")


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


def measure(config: ThroughputConfig) -> list[Row]:
    """Measure all variants of the scenarios, with a bar on the error stream meanwhile."""
    import torch

    from izoo.benchmarks.timing.throughput_plan import Plan, scenarios
    from izoo.benchmarks.timing.variants import make_variants

    torch.set_num_threads(1)
    names, twins = config.scenarios, itertools.product(config.twin_threads, config.twin_envs)
    plan = Plan(tuple(scenarios()[name] for name in names), ROUNDS, config.workers, config.steps)
    rows = []
    with contextlib.ExitStack() as stack:
        variants = make_variants(plan, [(envs, threads) for threads, envs in twins if threads <= envs])
        for variant in variants.values():
            stack.callback(variant.close)
        played = 0
        bar = stack.enter_context(Progress(len(names) * ROUNDS * len(variants), unit="plays", file=sys.stderr))
        for number, name in enumerate(names):
            samples: dict[str, list[Sample]] = {label: [] for label in variants}
            for _ in range(ROUNDS):
                for label, variant in variants.items():
                    samples[label].append(variant.play(number))
                    played += 1
                    bar.update(played, f"{name}: {label}")
            rows += _rows(name, samples)
    return rows


def _rows(scenario: str, samples: dict[str, list[Sample]]) -> list[Row]:
    """Return the medians; the ratios are those within a round."""
    bare = [sample.env_steps_per_s for sample in next(iter(samples.values()))]
    rows = []
    for label, values in samples.items():
        rate, agent_rate = (statistics.median(column) for column in zip(*(v[:2] for v in values), strict=True))
        ratio = statistics.median(value[0] / base for value, base in zip(values, bare, strict=True))
        vehicles, agents = (statistics.median(column) for column in zip(*(v[2:] for v in values), strict=True))
        rows.append(Row(scenario, label, rate, agent_rate, ratio, vehicles, agents))
    return rows


def print_tables(rows: Sequence[Row]) -> None:
    """Print the rows, a table per scenario."""
    from izoo.report.tables import Table

    columns = "variant", "env\nsteps/s", "to\nbare", "CV\nsteps/s", "vehi-\ncles", "CVs"
    for scenario, group in itertools.groupby(rows, lambda row: row.scenario):
        lines = [
            (
                row.variant,
                *(f"{row.env_steps_per_s:,.0f}", f"{row.ratio_to_bare:.2f}", f"{row.agent_steps_per_s:,.0f}"),
                *(f"{row.vehicles:.0f}", f"{row.agents:.0f}"),
            )
            for row in group
        ]
        Table.of(f"{scenario}: medians of {ROUNDS} rounds", columns, lines).show()


def run(config: ThroughputConfig, given: frozenset[str] = frozenset()) -> list[Row]:
    """Measure, and print the tables."""
    print("Loading torch and SUMO.", flush=True)
    rows = measure(config)
    print_tables(rows)
    return rows


COMMAND = OptionCommand(
    name="benchmarks.throughput",
    summary="Measure how fast environments run, beside bare libsumo on the same network, demand and machine.",
    examples=("izoo.benchmarks.throughput", "izoo.benchmarks.throughput scenarios=[medium] workers=4"),
    config="izoo.benchmarks.throughput:ThroughputConfig",
    work="izoo.benchmarks.throughput:run",
)
main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
