"""Results as one HTML page that opens from disk and asks for nothing else."""

from __future__ import annotations

import base64
import dataclasses
import gzip
import json
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from izoo import __version__
from izoo.errors import IzooError, check_choice
from izoo.files import os_reason, write_text
from izoo.metrics.figures import FIGURES
from izoo.metrics.pairing import BASELINES, UNCOMMANDED
from izoo.report import plots, tables
from izoo.report.movements import movements_table, town_maps
from izoo.report.paper_results import paper_table, published_for
from izoo.report.replay import Player, scenes
from izoo.report.report_data import Evaluation, Results, collect, context_rows
from izoo.report.tables import SAVED
from izoo.results.schema import FEATURES
from izoo.training.plots import Chart, curves

PAGE_FILE = "report.html"
TEMPLATES = "templates"
SCRIPTS = ("common.js", "features.js", "table.js", "replay.js")
REPLAY_POLICIES = 6
REPLAY_BYTES = 4_000_000
"""Replays beyond this many bytes in all are left out, so that the page stays small enough to send."""
FIRST_COLUMNS = ("context", "policy", "test", SAVED, plots.DELAY, "co2_g", "delay_s")
"""Columns of the table of contexts that are shown before others are asked for."""
Note = Callable[[str], None]


def write_report(
    results: Path,
    out: Path | None = None,
    title: str | None = None,
    *,
    task: str | None = None,
    replay: bool = True,
    imports: bool = False,
    partial: bool = False,
    note: Note = lambda _: None,
) -> Path:
    """Write the page of a folder of results.

    Args:
        results: an evaluation, a training run, or a benchmark.
        out: the page; ``None``: ``report.html`` in that folder.
        title: of the page; ``None``: what the folder says.
        task: show this one alone; ``None``: all.
        replay: show the best and the worst context of every policy; they are played again once, and then kept.
        imports: policies written ``module:function`` may be imported for that.
        partial: accept results that are not complete.
        note: called with what takes time, and with what is left out.

    Returns:
        the page's path.

    Raises:
        IzooError: the folder holds no whole results, or the page cannot be written.
    """
    found = collect(results, partial)
    if task is not None:
        check_choice("task", task, [evaluation.task for evaluation in found.evaluations])
        found = dataclasses.replace(found, evaluations=tuple(each for each in found.evaluations if each.task == task))
    found = dataclasses.replace(found, title=found.title if title is None else title)
    path = out or results / PAGE_FILE
    if path.is_dir():
        raise IzooError(f"{path} is a folder; name a file: out={path / PAGE_FILE}.")
    if path.exists() and path.stat().st_size and not _is_ours(path):
        raise IzooError(f"{path} exists and is not a report; it is not overwritten. Choose another file with out=FILE.")
    text = render(found, replay=replay, imports=imports, note=note)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
    except OSError as error:
        raise IzooError(f"cannot write {path}: {os_reason(error)}; choose another place with out=FILE.") from error
    return path


def _is_ours(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return b'name="generator" content="izoo.report"' in file.read(4096)


def render(results: Results, *, replay: bool = True, imports: bool = False, note: Note = lambda _: None) -> str:
    """Return the page of collected results."""
    played, lost = _replays(results.evaluations, imports, note) if replay else ([], [])
    drawn = _charts(results)
    policies = dict.fromkeys(name for evaluation in results.evaluations for name in evaluation.policies)
    content = {
        "rows": context_rows(results.evaluations),
        "columns": _columns(several=len(results.evaluations) > 1),
        "features": FEATURES,
        "measure": {"key": SAVED, "label": f"{FIGURES[SAVED].label} ({FIGURES[SAVED].unit})"},
        "colours": plots.colours(list(policies)),
        "scenes": [scene for scene, _ in played],
    }
    environment = Environment(
        loader=PackageLoader("izoo.report", TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html").render(
        title=results.title,
        version=__version__,
        facts=results.facts,
        parts=[_part(evaluation) for evaluation in results.evaluations],
        several=len(results.evaluations) > 1,
        charts={part: [(chart, plots.svg(chart)) for chart in of] for part, of in drawn.items()},
        lost=lost,
        style=_asset("style.css"),
        script="\n".join(_asset(name) for name in SCRIPTS),
        content=_pack(json.dumps(content, separators=(",", ":"), allow_nan=False).encode()),
        replays=[base64.b64encode(packed).decode() for _, packed in played],
    )


def _part(evaluation: Evaluation) -> dict[str, Any]:
    """What the page says of an evaluation in tables."""
    summary, movements = evaluation.summary, movements_table(evaluation)
    headline, *further = tables.shown_first(summary)
    return {
        "name": evaluation.name,
        "verdict": summary["verdict"],
        "counts": tables.counts(summary),
        "cautions": tables.cautions(summary),
        "headline": headline.html(),
        "further": [table.html() for table in further],
        "pairs": len(summary["pairwise"]),
        "pairwise": tables.pairwise(summary).html() if summary["pairwise"] else "",
        "details": [table.html() for table in tables.details(summary)],
        "left_out": summary["n"]["left_out"],
        "movements": movements.html() if movements else "",
        "maps": town_maps(evaluation),
        "closed_by": {name: of["closed_by"] for name, of in evaluation.paper.items() if of["closed_by"]},
        "paper": paper_table(evaluation.paper, evaluation.task).html() if published_for(evaluation.task) else "",
    }


def _charts(results: Results) -> dict[str, list[Chart]]:
    found: dict[str, list[Chart]] = {"summary": [], "histograms": [], "published": []}
    for k, evaluation in enumerate(results.evaluations):
        place = f"-{k}" if k else ""
        values = {
            name: evaluation.contexts(name)[SAVED].dropna() for name in evaluation.policies if name != UNCOMMANDED
        }
        if len(tables.compared(evaluation.summary)) > 1:
            chart = plots.forest(tables.entries(evaluation.summary), f"forest{place}")
            found["summary"].append(dataclasses.replace(chart, title=plots.figure_label(SAVED)))
        found["summary"].append(dataclasses.replace(plots.profiles(values), name=f"profiles{place}"))
        traded = plots.tradeoff(evaluation.summary)
        found["summary"] += [dataclasses.replace(traded, name=f"tradeoff{place}")] if traded else []
        tint = plots.colours(list(values))
        for j, (name, of) in enumerate(values.items()):
            found["histograms"].append(plots.histogram(of, name, f"histogram{place}-{j}", colour=tint[name]))
        if published_for(evaluation.task):
            chart = plots.forest(paper_table(evaluation.paper, evaluation.task), f"published{place}", 1)
            found["published"].append(chart)
    tint = plots.colours([name for evaluation in results.evaluations for name in evaluation.policies])
    found["curves"] = curves(results.curves, colours={name: tint[name] for name in results.curves if name in tint})
    return found


def _columns(several: bool) -> list[dict[str, Any]]:
    """Columns of the table of contexts: names, every figure, features, counts."""

    def column(key: str, label: str, digits: int | None = None, meaning: str = "") -> dict[str, Any]:
        return {"key": key, "label": label, "digits": digits, "meaning": meaning, "more": key not in FIRST_COLUMNS}

    found = [column("context", "context"), column("policy", "policy")]
    found += [column("test", "evaluation")] if several else []
    for figure in FIGURES.values():
        unit = f" ({figure.unit})" if figure.unit else ""
        found.append(
            column(figure.name, figure.label + unit, figure.digits, f"over {UNCOMMANDED}" if figure.paired else "")
        )
    found.append(
        column("volume_over_capacity", FEATURES["volume_over_capacity"], 2, "above 1 the intersection is saturated")
    )
    return [*found, column("train_seeds", "training seeds", 0)]


def _replays(
    evaluations: Sequence[Evaluation], imports: bool, note: Note
) -> tuple[list[tuple[dict[str, Any], bytes]], list[tuple[str, str]]]:
    """Replays of the best policies, in the page's order, and why others are missing."""
    played: list[tuple[dict[str, Any], bytes]] = []
    lost: list[tuple[str, str]] = []
    with Player(imports) as player:
        for evaluation in evaluations:
            able = [name for name in tables.ranking(evaluation.summary) if name not in BASELINES]
            able = [name for name in able if not name.endswith(plots.UNTRAINED)] or able
            if able[REPLAY_POLICIES:]:
                lost.append((", ".join(able[REPLAY_POLICIES:]), f"only the {REPLAY_POLICIES} best are replayed."))
            for name in able[:REPLAY_POLICIES]:
                for scene in scenes(evaluation, name):
                    try:
                        packed = player.replay(scene, note)
                    except (IzooError, OSError) as error:
                        text = str(error).replace(str(evaluation.folder), evaluation.folder.name)
                        lost.append((name, text))
                        note(f"No replay of {name}: {text}")
                        break
                    if sum(len(other) for _, other in played) + len(packed) > REPLAY_BYTES:
                        lost.append((name, f"the {scene.which} context would make the page too large."))
                        continue
                    played.append((scene.described(), packed))
    return played, lost


def _asset(name: str) -> str:
    return (resources.files("izoo.report") / TEMPLATES / name).read_text(encoding="utf-8")


def _pack(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode()
