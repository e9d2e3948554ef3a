"""The subcommands of ``python -m izoo.contexts`` that need nets or simulations, beside those of the room itself.

Whatever is slow to import is imported when a subcommand runs, so that each says something at once.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from izoo.commands import scenarios as basic
from izoo.contexts.cities.rebuilt import SIZES
from izoo.errors import IzooError


def _import_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", type=Path, help="a folder or zip archive of intersection folders")
    parser.add_argument("target", type=Path, nargs="?", help="a new folder; default: datasets/NAME in this folder")


def _import(options: argparse.Namespace) -> None:
    target = options.target or Path("datasets", options.path.resolve().stem)
    print(f"checking {options.path}", flush=True)
    from izoo.networks.dataset.importing import import_dataset

    print(import_dataset(options.path, target, progress=_show_progress))
    print(f"train on it: python -m izoo.train contexts=dataset contexts.path={target}")


def _show_progress(done: int, total: int) -> None:
    if sys.stderr.isatty():
        print(f"\r{done} of {total} folders", end="\n" if done == total else "", file=sys.stderr, flush=True)


def _build_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--osm", type=Path, required=True, metavar="FILE", help="an extract, .osm or .osm.pbf")
    parser.add_argument("--elevation", type=Path, metavar="TIF", help="heights in m; without it streets are level")
    parser.add_argument("--aadt", type=Path, metavar="CSV", help="columns aadt (veh/day) and way (id) or name")
    parser.add_argument("target", type=Path, help="a new folder, or an earlier build, which is replaced")


def _build(options: argparse.Namespace) -> None:
    print(f"reading {options.osm}", flush=True)
    from izoo.networks.osm.extract import build_from_osm

    print(build_from_osm(options.osm, target=options.target, elevation=options.elevation, aadt=options.aadt))
    print(f"train on it: python -m izoo.train contexts=osm contexts.path={options.target}")


def _draw_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("what", help="an id, CITY, CITY/NUMBER, or a path: an intersection, or a folder of them")
    parser.add_argument("png", type=Path, help="the picture to write")


def _draw(options: argparse.Namespace) -> None:
    print(f"drawing {options.what}", flush=True)
    from izoo.commands.pictures import draw

    print(f"wrote {draw(options.what, options.png)}")


def _compare_arguments(parser: argparse.ArgumentParser) -> None:
    basic.compare_arguments(parser)
    parser.add_argument(
        "--measured",
        type=Path,
        metavar="PATH",
        help="compare rebuilt Salt Lake City with the measured intersections in this folder instead",
    )
    parser.add_argument("--seeds", type=int, default=1, help="with --measured: episodes per intersection")
    parser.add_argument("--horizon-s", type=float, default=1000.0, help="with --measured: length of an episode in s")
    parser.add_argument("--num-workers", type=int, default=2, help="with --measured: simulators at the same time")


def _compare(options: argparse.Namespace) -> None:
    if options.measured is None:
        basic.compare(options)
        return
    if options.city:
        raise IzooError("--city does not go with --measured, which compares Salt Lake City.")
    print(f"reading {options.measured}", flush=True)
    from izoo.commands import measured

    comparison = measured.compare(options.measured, options.seeds, options.horizon_s, options.num_workers)
    print(measured.describe(comparison))
    if options.csv:
        measured.write_csv(comparison, options.csv)
    if options.png:
        measured.write_png(comparison, options.png)


def _try_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", type=Path, nargs="?", help="a folder of intersections; default: the built-in cities")
    parser.add_argument("--city", action="append", help="instead of all ten; may be given several times")
    parser.add_argument("--count", type=int, help="intersections to draw; default: 10 per city, or all of PATH")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    parser.add_argument("--horizon-s", type=float, default=200.0, help="length of each episode in s")


def _try(options: argparse.Namespace) -> None:
    if options.path is not None and options.city:
        raise IzooError("--city does not go with a path; leave one of them out.")
    print(f"trying {options.path or ', '.join(options.city or SIZES)}", flush=True)
    from izoo.commands import trial

    specs = trial.choose(options.path, options.city, options.count, options.seed)
    report = trial.run(specs, options.horizon_s, options.seed, progress=True)
    print(report)
    if report.failures:
        raise IzooError(f"{len(report.failures)} of {report.episodes} episodes failed.")


COMMANDS = (
    *(command for command in basic.COMMANDS if command.name != "compare"),
    basic.Command(
        "compare", "compare rebuilt cities with published statistics, or measured nets", _compare_arguments, _compare
    ),
    basic.Command("import", "check and import a downloaded dataset", _import_arguments, _import),
    basic.Command("build", "make intersections of an OpenStreetMap extract", _build_arguments, _build),
    basic.Command("draw", "draw an intersection, or the features of many", _draw_arguments, _draw),
    basic.Command("try", "build the nets of some intersections and play a short episode in each", _try_arguments, _try),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a subcommand and return the exit code: 0, or 2 for input that the user can mend."""
    return basic.main(argv, COMMANDS)
