"""How fast environments run, beside bare libsumo on the same network, demand and machine.

``python -m izoo.benchmarks.throughput [--json] [--workers N] [--scenarios light,medium,heavy] [--steps N]``

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

import argparse
import contextlib
import json
import statistics
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import TYPE_CHECKING

from izoo.benchmarks.stopwatch import CHUNK
from izoo.console import exit_code

if TYPE_CHECKING:
    from izoo.benchmarks.variants import Sample

ROUNDS = 3
SCENARIOS = ("light", "medium", "heavy")


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


def measure(names: Sequence[str], workers: int, steps: int) -> list[Row]:
    """Measure all variants of the named scenarios, a bar on the error stream meanwhile.

    Args:
        names: scenarios, of :data:`SCENARIOS`.
        workers: processes of the variants that have several.
        steps: timed steps per environment, variant and round.
    """
    import torch
    from rich.console import Console
    from rich.progress import Progress

    from izoo.benchmarks.variants import Plan, make_variants, scenarios

    torch.set_num_threads(1)
    plan = Plan(tuple(scenarios()[name] for name in names), ROUNDS, workers, steps)
    rows = []
    with contextlib.ExitStack() as stack:
        variants = make_variants(plan)
        for variant in variants.values():
            stack.callback(variant.close)
        bar = stack.enter_context(Progress(console=Console(stderr=True), transient=True))
        task = bar.add_task("", total=len(names) * ROUNDS * len(variants))
        for number, name in enumerate(names):
            samples: dict[str, list[Sample]] = {label: [] for label in variants}
            for turn in range(1, ROUNDS + 1):
                if not bar.console.is_terminal:
                    print(f"{name}: round {turn} of {ROUNDS}", file=sys.stderr, flush=True)
                for label, variant in variants.items():
                    bar.update(task, description=f"{name}: {label}")
                    samples[label].append(variant.play(number))
                    bar.advance(task)
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
    """Print the rows for people, a table per scenario."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    console = Console()
    for scenario, group in groupby(rows, lambda row: row.scenario):
        table = Table(
            title=f"{scenario}: medians of {ROUNDS} rounds", title_justify="left", box=SIMPLE_HEAD, pad_edge=False
        )
        table.add_column("variant", no_wrap=True)
        for heading in ("env steps/s", "to bare", "CV steps/s", "vehicles", "CVs"):
            table.add_column(heading, justify="right")
        for row in group:
            rates = f"{row.env_steps_per_s:,.0f}", f"{row.ratio_to_bare:.2f}", f"{row.agent_steps_per_s:,.0f}"
            table.add_row(row.variant, *rates, f"{row.vehicles:.0f}", f"{row.agents:.0f}")
        console.print(table)


def main(argv: list[str] | None = None) -> int:
    """Run the benchmark; returns the exit code."""
    parser = argparse.ArgumentParser("python -m izoo.benchmarks.throughput", description=__doc__.split("\n")[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.add_argument("--workers", type=int, default=2, help="worker processes (default 2)")
    parser.add_argument("--steps", type=int, default=400, help="timed steps per row and round (default 400)")
    parser.add_argument("--scenarios", default="light,medium,heavy", help="comma-separated (default all three)")
    options = parser.parse_args(argv)
    chosen = options.scenarios.split(",")
    for name in chosen:
        if name not in SCENARIOS:
            parser.error(f"unknown scenario {name!r}; choose from: {', '.join(SCENARIOS)}")
    if options.workers < 1:
        parser.error(f"--workers is {options.workers}; one or more are needed")
    if options.steps < CHUNK or options.steps % CHUNK:
        parser.error(
            f"--steps is {options.steps}; it must be a multiple of {CHUNK}: collectors are timed in such batches"
        )
    print("izoo throughput: loading torch and SUMO", file=sys.stderr, flush=True)
    rows = measure(chosen, options.workers, options.steps)
    if options.json:
        print(json.dumps({"workers": options.workers, "rows": [asdict(row) for row in rows]}, indent=1))
    else:
        print_tables(rows)
    return 0


if __name__ == "__main__":
    sys.exit(exit_code("benchmarks.throughput", main))
