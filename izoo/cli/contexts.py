"""``python -m izoo.contexts``: show, list and count scenarios, compare, import, build and draw intersections."""

from __future__ import annotations

import argparse
import contextlib
import sys
from pathlib import Path

from izoo.cli.subcommands import SubcommandCommand, argument
from izoo.console import Progress, counted, plain, survives_lost_output
from izoo.contexts import catalogue
from izoo.contexts.cities.plans import measure
from izoo.contexts.cities.rebuilt import CITIES, SIZES, city_name, get
from izoo.contexts.context import ENGINES, HOURS, SEASONS, Context
from izoo.contexts.splits import SPLITS
from izoo.errors import IzooError
from izoo.networks.osm.streets import SIDES

CONTEXTS = SubcommandCommand(
    "contexts",
    "Show, list and count scenarios; compare rebuilt cities with published statistics; import, build and draw "
    "intersections.",
)
FILTERS = (
    argument("--city", action="append", help="may be given several times, as all filters"),
    argument("--season", action="append", choices=SEASONS),
    argument("--hour", action="append", choices=HOURS),
    argument("--engine", action="append", choices=ENGINES),
    argument("--adoption", action="append", type=float, help="a share; default: the catalogue's five levels"),
    argument("--split", choices=(*SPLITS, "all"), default="all"),
    argument("--approaches", choices=catalogue.APPROACHES, default="all", help="one context per approach?"),
)


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


@CONTEXTS.command("print one scenario", argument("id", type=int, help=f"0 to {catalogue.SIZE - 1}"))
def _show(options: argparse.Namespace) -> None:
    print(describe_context(catalogue.get(options.id)))


def _scenarios(options: argparse.Namespace) -> catalogue.Scenarios:
    names = ("city", "season", "hour", "engine", "adoption", "split", "approaches")
    return catalogue.Scenarios(**{name: getattr(options, name) for name in names})


@CONTEXTS.command(
    "print the scenarios that pass a filter",
    *FILTERS,
    argument("--limit", type=int, default=20, help="lines to print; 0 prints all"),
)
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


@CONTEXTS.command("count the scenarios that pass a filter", *FILTERS)
def _count(options: argparse.Namespace) -> None:
    print(len(_scenarios(options)))


@CONTEXTS.command("print the ten cities")
def _cities(_: argparse.Namespace) -> None:
    for city, size in SIZES.items():
        print(f"{city:20} {size:6} intersections {size * catalogue.PER_INTERSECTION:9} scenarios")
    print(f"{'all':20} {catalogue.INTERSECTIONS:6} intersections {catalogue.SIZE:9} scenarios")


@CONTEXTS.command(
    "compare rebuilt cities with published statistics",
    argument("--city", action="append", help="default: all ten"),
)
def _compare(options: argparse.Namespace) -> None:
    from izoo.contexts.cities.compare import feature_table, format_distances

    tables = {name: feature_table(get(name)) for name in map(city_name, options.city or CITIES)}
    print("total variation between rebuilt and published distributions, before the flow cap (target: at most 0.05)")
    print(format_distances(tables))


@CONTEXTS.command(
    "check and import a downloaded dataset",
    argument("path", type=Path, help="a folder or zip archive of intersection folders"),
    argument("target", type=Path, nargs="?", help="a new folder; default: datasets/NAME in this folder"),
)
@survives_lost_output()
def _import(options: argparse.Namespace) -> None:
    target = options.target or Path("datasets", options.path.resolve().stem)
    print(f"checking {plain(options.path)}", flush=True)
    from izoo.networks.dataset.importing import import_dataset

    shown: list[Progress] = []

    def show(done: int, total: int) -> None:
        if not shown:
            shown.append(waiting.enter_context(Progress(total, unit="folders", file=sys.stderr)))
        shown[0].update(done)

    with contextlib.ExitStack() as waiting:
        report = import_dataset(options.path, target, progress=show)
    print(report)
    print(f"train on it: python -m izoo.train contexts=dataset contexts.path={plain(target)}")


@CONTEXTS.command(
    "make intersections of an OpenStreetMap extract",
    argument("--osm", type=Path, required=True, metavar="FILE", help="an extract, .osm or .osm.pbf"),
    argument("--elevation", type=Path, metavar="TIF", help="heights in m; without it streets are level"),
    argument("--aadt", type=Path, metavar="CSV", help="columns aadt (veh/day) and way (id) or name"),
    argument("--signals", type=Path, metavar="JSON", help="signal plans by intersection; others are searched for"),
    argument("--counts", type=Path, metavar="CSV", help="columns intersection, from, to (legs), vph at the peak"),
    argument("--drives-on", choices=SIDES, help="the side of traffic; default: that of the country"),
    argument("target", type=Path, help="a new folder, or an earlier build, which is replaced unless it was edited"),
)
@survives_lost_output()
def _build(options: argparse.Namespace) -> None:
    print(f"reading {plain(options.osm)}", flush=True)
    from izoo.networks.osm.extract import build_from_osm

    names = ("target", "elevation", "aadt", "signals", "counts", "drives_on")
    print(build_from_osm(options.osm, **{name: getattr(options, name) for name in names}))
    print(f"train on it: python -m izoo.train contexts=osm contexts.path={plain(options.target)}")


@CONTEXTS.command(
    "draw an intersection, or the features of many",
    argument("what", help="a path (an intersection, or a folder of some), or an id, CITY or CITY/NUMBER"),
    argument("png", type=Path, help="the picture to write"),
)
@survives_lost_output()
def _draw(options: argparse.Namespace) -> None:
    print(f"drawing {plain(options.what)}", flush=True)
    from izoo.cli.draw import draw

    print(f"wrote {plain(draw(options.what, options.png))}")


@CONTEXTS.command(
    "build the nets of some intersections and play two short episodes in each",
    argument("path", type=Path, nargs="?", help="a folder of intersections; default: the built-in cities"),
    argument("--city", action="append", help="instead of all ten; may be given several times"),
    argument("--count", type=int, help="intersections to draw; default: 10 per city, or all of PATH"),
    argument("--seed", type=int, default=0, help="of the draw"),
    argument("--horizon-s", type=float, default=200.0, help="length of each episode in s"),
)
def _try(options: argparse.Namespace) -> None:
    if options.path is not None and options.city:
        raise IzooError("--city does not go with a path; leave one of them out.")
    print(f"trying {options.path or ', '.join(options.city or SIZES)}", flush=True)
    from izoo.cli import smoke_test

    specs = smoke_test.choose(options.path, options.city, options.count, options.seed)
    report = smoke_test.run(specs, options.horizon_s, options.seed, progress=True)
    print(report)
    if report.failures:
        tried = f"{counted(report.intersections, 'intersection')} and {counted(report.episodes, 'episode')}"
        raise IzooError(f"{counted(len(report.failures), 'failure')} in {tried}.")
