"""``python -m izoo.contexts``: show, list and count scenarios; compare rebuilt cities with the published statistics."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from izoo.contexts import catalogue
from izoo.contexts.cities.compare import compare_cities, format_distances, write_csv, write_png
from izoo.contexts.cities.plans import measure
from izoo.contexts.cities.rebuilt import CITIES, SIZES, city_name
from izoo.contexts.context import ENGINES, HOURS, SEASONS, Context
from izoo.contexts.splits import SPLITS
from izoo.errors import IzooError
from izoo.files import os_reason

EXIT_BAD_INPUT, EXIT_INTERRUPTED = 2, 130


class Command(NamedTuple):
    """A subcommand: its name, one line of help, its arguments, and what it does."""

    name: str
    help: str
    arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], None]


def describe_context(context: Context) -> str:
    """Return a page of text about a context."""
    spec = context.intersection
    identity = "not in the catalogue" if context.context_id is None else f"id {context.context_id}"
    lines = [
        f"{context.name}  ({identity}, {spec.source})",
        f"  {context.hour}, {context.season or 'weather given'}: {context.temperature_c:.1f} C, "
        f"{context.humidity_pct:.0f} % humidity; {context.engine} CVs, adoption {context.adoption:.0%}",
        f"  content hash {context.content_hash}",
    ]
    for leg in spec.legs:
        approach = leg.approach
        if approach is None:
            lines.append(f"  {leg.name} at {leg.bearing_deg:.0f} deg: leads away only, {leg.exit_lanes} lanes")
            continue
        pocket = f", pocket {approach.pocket_length_m:.0f} m" if approach.pocket_length_m else ""
        lines.append(
            f"  {leg.name} at {leg.bearing_deg:.0f} deg: lanes {' | '.join(approach.lanes)} (right to left){pocket}, "
            f"{approach.length_m:.0f} m, {approach.speed_limit_mps:.1f} m/s, grade {100 * approach.grade:+.1f} %, "
            f"{context.flow_vph_per_lane(leg.name):.0f} veh/h per lane"
        )
        if spec.signal_plan is not None:
            phases, share = measure(spec.signal_plan, leg.name)
            lines[-1] += f", {phases} phases, green {share:.0%}"
    if spec.signal_plan is not None:
        lines.append(f"  signal: cycle {spec.signal_plan.cycle_s:g} s")
        for phase in spec.signal_plan.phases:
            colours = " ".join(f"{start}{end}:{colour}" for start, end, colour in phase.states)
            lines.append(f"    {phase.duration_s:5.1f} s  {colours}")
    if spec.source == "city":
        lines.append("  Rebuilt from published statistics; not a measured intersection.")
    return "\n".join(lines)


def _show_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("id", type=int, help=f"0 to {catalogue.SIZE - 1}")


def _show(options: argparse.Namespace) -> None:
    print(describe_context(catalogue.get(options.id)))


def _filter_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--city", action="append", help="may be given several times, as all filters")
    parser.add_argument("--season", action="append", choices=SEASONS)
    parser.add_argument("--hour", action="append", choices=HOURS)
    parser.add_argument("--engine", action="append", choices=ENGINES)
    parser.add_argument("--adoption", action="append", type=float, help="a share; default: the catalogue's five levels")
    parser.add_argument("--split", choices=(*SPLITS, "all"), default="all")
    parser.add_argument("--approaches", choices=catalogue.APPROACHES, default="all", help="one context per approach?")


def _scenarios(options: argparse.Namespace) -> catalogue.Scenarios:
    names = ("city", "season", "hour", "engine", "adoption", "split", "approaches")
    return catalogue.Scenarios(**{name: getattr(options, name) for name in names})


def _count(options: argparse.Namespace) -> None:
    print(len(_scenarios(options)))


def _list_arguments(parser: argparse.ArgumentParser) -> None:
    _filter_arguments(parser)
    parser.add_argument("--limit", type=int, default=20, help="lines to print; 0 prints all")


def _list(options: argparse.Namespace) -> None:
    if options.limit < 0:
        raise IzooError(f"--limit is {options.limit}; give 0 (everything) or a positive number.")
    scenarios = _scenarios(options)
    shown = len(scenarios) if options.limit == 0 else min(options.limit, len(scenarios))
    for index in range(shown):
        scenario, approach = scenarios.locate(index)
        listed = approach is None and scenario.adoption in catalogue.ADOPTIONS
        identity = str(catalogue.find_id(*scenario)) if listed else "-"
        place = f"{scenario.city}/{scenario.intersection}" + (f"/{approach}" if approach else "")
        settings = f"{scenario.season:7} {scenario.adoption:<6.3g} {scenario.hour:9} {scenario.engine}"
        print(f"{identity:>8}  {place:28} {settings}")
    if shown < len(scenarios):
        print(f"... {len(scenarios) - shown} more; --limit 0 prints all", file=sys.stderr)


def _cities_arguments(parser: argparse.ArgumentParser) -> None:
    del parser


def _cities(options: argparse.Namespace) -> None:
    del options
    for city, size in SIZES.items():
        print(f"{city:20} {size:6} intersections {size * catalogue.PER_INTERSECTION:9} scenarios")
    print(f"{'all':20} {catalogue.INTERSECTIONS:6} intersections {catalogue.SIZE:9} scenarios")


def compare_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``compare``."""
    parser.add_argument("--city", action="append", help="default: all ten")
    parser.add_argument("--csv", type=Path, help="write the distances here")
    parser.add_argument("--png", type=Path, help="draw the histograms here")


def compare(options: argparse.Namespace) -> None:
    """Print, and write if asked to, how far rebuilt cities are from the published statistics."""
    tables = compare_cities([city_name(city) for city in options.city or CITIES])
    print("total variation between rebuilt and published distributions, before the flow cap (target: at most 0.05)")
    print(format_distances(tables))
    if options.csv:
        write_csv(tables, options.csv)
    if options.png:
        write_png(tables, options.png)


COMMANDS = (
    Command("show", "print one scenario", _show_arguments, _show),
    Command("list", "print the scenarios that pass a filter", _list_arguments, _list),
    Command("count", "count the scenarios that pass a filter", _filter_arguments, _count),
    Command("cities", "print the ten cities", _cities_arguments, _cities),
    Command("compare", "compare rebuilt cities with the published statistics", compare_arguments, compare),
)


def main(argv: Sequence[str] | None = None, commands: Sequence[Command] = COMMANDS) -> int:
    """Run a subcommand and return the exit code: 0, or 2 for input that the user can mend."""
    parser = argparse.ArgumentParser(prog="python -m izoo.contexts", description=__doc__)
    subparsers = parser.add_subparsers(dest="command", required=True)
    for command in commands:
        subparser = subparsers.add_parser(command.name, help=command.help, description=command.help)
        command.arguments(subparser)
        subparser.set_defaults(run=command.run)
    options = parser.parse_args(argv)
    try:
        options.run(options)
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever read the output, such as ``head``, has had enough; what is left to flush must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        print("stopped.", file=sys.stderr)
        return EXIT_INTERRUPTED
    except IzooError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except OSError as error:
        if error.filename is None:
            raise
        print(f"error: cannot use {error.filename}: {os_reason(error)}; choose another path.", file=sys.stderr)
        return EXIT_BAD_INPUT
    return 0
