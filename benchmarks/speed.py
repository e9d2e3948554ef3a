"""How fast izoo is on this machine: ``python -m izoo.benchmarks.speed``, or ``python benchmarks/speed.py --machine``.

Rows of the twin are measured beside bare libsumo, on the same nets and demand, in one run: stepping, stepping with a
policy, training, the start, and CO2 alone. Each is timed for the same few seconds. Where SUMO is not installed, its
rows and the start are left out, and nets come from the cache.

``serial`` is the processor time of the main thread in a step of all environments that no number of threads shrinks: all
that it does beyond its own share of what threads do side by side. ``most`` is the speed-up over one core that this
allows on 16 (Amdahl's law).
"""

from __future__ import annotations

import functools
import importlib.util
import platform
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from izoo.cli.option_command import OptionCommand
from izoo.console import Progress
from izoo.cores import usable_cores
from izoo.errors import check_range
from izoo.options import CheckedOptions

if TYPE_CHECKING:
    from izoo.benchmarks.timing.rows import Row

LEGEND = (
    "twin E x T: E environments, T threads; to bare: ratio to bare libsumo; veh.: vehicles in the controlled region; "
    "serial: time of the main thread in a step of all environments that more threads do not reduce, and its share of "
    "all work; most: the largest possible speed-up on 16 cores with that share."
)
RowName = Literal["sumo", "twin", "policy", "training", "start", "emissions"]
Scenario = Literal["two_lanes", "light", "medium", "heavy"]


@dataclass(frozen=True)
class SpeedConfig(CheckedOptions):
    """Options of the speed benchmark.

    Attributes:
        rows: what is measured.
        scenario: the traffic; ``two_lanes`` has some 30 vehicles, ``light``, ``medium`` and ``heavy`` 20, 60 and 190.
        envs: environments on the twin; the last is also measured with a policy and in training.
        threads: threads of the twin, at most one per environment; empty: one, and one per core.
        surrogate: what computes CO2 on the twin.
        workers: processes of SUMO.
        starting: environments whose start is measured, each with a net of its own.
        device: of the learner.
        seconds: how long each row is timed.
        machine: measure what describes a machine, in some ten minutes: more environments and threads, and a start of
            2,048; also written ``--machine``. Its table is Markdown.
    """

    rows: tuple[RowName, ...] = ("sumo", "twin", "policy", "training", "start", "emissions")
    scenario: Scenario = "two_lanes"
    envs: tuple[int, ...] = (64, 512)
    threads: tuple[int, ...] = ()
    surrogate: Literal["torch", "cuda", "compiled"] = "compiled"
    workers: int = 2
    starting: int = 64
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seconds: float = 3.0
    machine: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        for count in self.envs:
            check_range("envs", count, 1, 65536)
        for count in self.threads:
            check_range("threads", count, 1, 1024)
        check_range("workers", self.workers, 1, 1024)
        check_range("starting", self.starting, 1, 65536)
        check_range("seconds", self.seconds, 0.01, 600.0)


def whole_machine(config: SpeedConfig) -> SpeedConfig:
    """Return the options that describe a machine."""
    cores = usable_cores()
    threads = tuple(count for count in (1, 2, 4, 8, 16, 32, 64) if count < cores)
    return replace(config, envs=(64, 4096, 512), threads=(*threads, cores), workers=min(cores, 16), starting=2048)


def plan(config: SpeedConfig) -> Iterator[tuple[str, Callable[[], list[Row]]]]:
    """Yield what each row is called and what measures it, in order."""
    from izoo.benchmarks.timing import rows

    context, seconds, surrogate = rows.scenarios()[config.scenario], config.seconds, config.surrogate
    threads = config.threads or tuple(dict.fromkeys((1, usable_cores())))
    most, last = max(threads), config.envs[-1]
    has_sumo = importlib.util.find_spec("libsumo") is not None
    if "start" in config.rows and importlib.util.find_spec("sumo"):
        # First, as memory that others have held would count as free.
        yield "start", lambda: [rows.start(config.starting, min(most, config.starting), surrogate)]
    if "sumo" in config.rows and has_sumo:
        yield "bare libsumo", lambda: [rows.bare_sumo(context, seconds)]
        yield "one environment on SUMO", lambda: [rows.one_on_sumo(context, seconds)]
        for name in ("parallel", "multisync"):
            measure = functools.partial(rows.workers_on_sumo, context, seconds, name, config.workers)
            yield f"{config.workers} workers, {name}", lambda measure=measure: [measure()]  # type: ignore[misc]
    if "twin" in config.rows:
        for envs in config.envs:
            # Thousands of environments take a minute to begin, so they are not measured with fewer threads.
            for count in dict.fromkeys(min(count, envs) for count in (threads if envs <= last else (most,))):
                yield (
                    f"twin {envs} x {count}",
                    functools.partial(rows.on_twin, context, seconds, envs, count, surrogate),
                )
    if "policy" in config.rows:
        yield "policy", lambda: [rows.with_policy(context, seconds, last, min(most, last), surrogate)]
    if "training" in config.rows:
        yield (
            "training",
            lambda: [rows.training(context, 2.0 * seconds, last, min(most, last), surrogate, config.device)],
        )
    if "emissions" in config.rows:
        yield "CO2", lambda: rows.emissions(seconds)


def print_table(rows: Sequence[Row], markdown: bool = False) -> None:
    """Print the rows; ``markdown``: to be pasted."""
    from izoo.report.tables import Table

    bare = next((row.env_steps_per_s for row in rows if row.name == "bare libsumo"), None)
    lines = []
    for row in (row for row in rows if row.timed or row.agent_steps_per_s):
        found = row.timed
        shared = found is not None and found.shared_s > 0.0
        lines.append(
            (
                row.name,
                f"{row.env_steps_per_s:,.0f}",
                f"{row.env_steps_per_s / bare:.2f}" if bare and found else "",
                "" if row.agent_steps_per_s is None else f"{row.agent_steps_per_s:,.0f}",
                "" if row.vehicles is None else f"{row.vehicles:.0f}",
                f"{1e6 * found.serial_s:,.0f}" if found and shared else "",
                f"{100.0 * found.serial_share:.1f}" if found and shared else "",
                f"{found.most:.1f}" if found and shared else "",
            )
        )
    columns = ["row", "env\nsteps/s", "to\nbare", "CV\nsteps/s", "veh.", "serial\nus", "serial\n%", "most"]
    if markdown:
        print(
            Table.of("", [column.replace("\n", " ") for column in columns], lines).markdown() + "\n\n" + LEGEND + "\n"
        )
    else:
        Table.of("speed (twin E x T: E environments, T threads)", columns, lines).show()
    for row in (row for row in rows if row.note):
        print(f"{'- ' if markdown else ''}{row.name}: {row.note}")


def this_machine() -> str:
    """Return what a table must say of the machine that it was measured on."""
    import torch

    from izoo import __version__

    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    return (
        f"{platform.processor() or platform.machine()}, {usable_cores()} cores, {gpu}; izoo {__version__}, "
        f"torch {torch.__version__}, Python {platform.python_version()}"
    )


def run(config: SpeedConfig) -> list[Row]:
    """Measure, with a bar on the error stream meanwhile, and print the table."""
    print("Loading torch and the simulators.", flush=True)
    config = whole_machine(config) if config.machine else config
    todo = list(plan(config))
    if {"sumo", "start"} & set(config.rows) and not importlib.util.find_spec("libsumo"):
        print("SUMO is not installed: rows that need it are left out.", flush=True)
    found: list[Row] = []
    with Progress(len(todo), unit="rows", file=sys.stderr) as bar:
        for number, (name, measure) in enumerate(todo):
            bar.update(number, name)
            found += measure()
        bar.update(len(todo), "done")
    if config.machine:
        print(this_machine() + "\n")
    print_table(found, config.machine)
    return found


COMMAND = OptionCommand(
    name="benchmarks.speed",
    summary="Measure how fast this machine steps, acts, trains and starts, beside bare libsumo.",
    examples=(
        "izoo.benchmarks.speed",
        "izoo.benchmarks.speed rows=[twin] envs=[512]",
        "izoo.benchmarks.speed machine=true",
    ),
    config="izoo.benchmarks.speed:SpeedConfig",
    work="izoo.benchmarks.speed:run",
)


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; ``--machine`` stands for ``machine=true``."""
    given = sys.argv[1:] if words is None else words
    return COMMAND.main(["machine=true" if word == "--machine" else word for word in given])


if __name__ == "__main__":
    sys.exit(main())
