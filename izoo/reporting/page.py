"""A results folder as one HTML page that opens from disk and asks for nothing else."""

from __future__ import annotations

import base64
import dataclasses
import functools
import gzip
import json
import math
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from plotly.offline import get_plotlyjs

from izoo import __version__
from izoo.console import counted
from izoo.errors import IzooError
from izoo.evaluation.across import counted_intersections, drives_electric
from izoo.evaluation.policies import HUMAN, UNCOMMANDED
from izoo.evaluation.show import intervals_in_words, nan_in_words, percent, score_rows
from izoo.evaluation.summary import seeds_per_context, summarise
from izoo.files import os_reason, write_text
from izoo.metrics.benefit import PAIR
from izoo.reporting import drawing, figures, histograms
from izoo.reporting.material import Material, collect
from izoo.reporting.published import PUBLISHED
from izoo.reporting.replay import Player, scenes
from izoo.reporting.rows import COLUMNS, FEATURES, approach_rows
from izoo.reporting.scored import Scored, improvement, score

PAGE_FILE = "report.html"
TEMPLATES = "templates"
SCRIPTS = ("common.js", "charts.js", "table.js", "replay.js")
REPLAY_POLICIES = 6
REPLAY_BYTES = 4_000_000
"""Replays beyond this many bytes in all are left out, so that the page stays small enough to send."""
SUMMARY_COLUMNS = (
    ("benefit, mean", "exact", "mean"),
    ("over uncommanded", "over_uncommanded", "mean"),
    ("whole region: mean", "region_exact", "mean"),
    ("region, over uncommanded", "region_over_uncommanded", "mean"),
    ("whole demand: mean", "demand_exact", "mean"),
    ("demand, over uncommanded", "demand_over_uncommanded", "mean"),
    ("throughput, mean change", "throughput", "mean"),
    ("approaches with benefit", "exact", "share_positive"),
    ("gated to 0", "exact", "share_gated"),
    ("interquartile mean", "exact", "iqm"),
    ("whole region: IQM", "region_exact", "iqm"),
    ("tested gate: mean", "tested", "mean"),
    ("tested gate: IQM", "tested", "iqm"),
    ("no gate: mean", "ungated", "mean"),
    ("kept throughput", "throughput", "share_kept"),
    ("demand served", "served", "policy"),
    ("kept out", "kept_out", "policy"),
)
"""Columns of the summary: label, part and statistic of :func:`izoo.evaluation.across.compare`."""
Note = Callable[[str], None]


def write_report(
    results: Path,
    out: Path | None = None,
    title: str | None = None,
    *,
    replay: bool = True,
    imports: bool = False,
    partial: bool = False,
    note: Note = lambda _: None,
) -> Path:
    """Write the page of a results folder.

    Args:
        results: an evaluation, a training run, a benchmark, or a trade-off sweep.
        out: the page; ``None``: ``report.html`` in that folder.
        title: of the page; ``None``: what the folder says.
        replay: show the best and the worst approach of every policy; they are played again once, and then kept.
        imports: policies written ``module:function`` may be imported for that.
        partial: accept a benchmark that is not finished.
        note: called with what takes time, and with what is left out.

    Returns:
        the page's path.

    Raises:
        IzooError: the folder holds no whole results, or the page cannot be written.
    """
    material = collect(results, partial)
    if title is not None:
        material = dataclasses.replace(material, title=title)
    path = out or results / PAGE_FILE
    if path.is_dir():
        raise IzooError(f"{path} is a folder; name a file: out={path / PAGE_FILE}.")
    if _is_foreign(path):
        raise IzooError(f"{path} exists and is no report; it is not overwritten. Choose another file with out=FILE.")
    text = render(material, replay=replay, imports=imports, note=note)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
    except OSError as error:
        raise IzooError(f"cannot write {path}: {os_reason(error)}; choose another place with out=FILE.") from error
    return path


def _is_foreign(path: Path) -> bool:
    """Whether a file holds something that :func:`write_report` has not written."""
    try:
        if not path.is_file() or path.stat().st_size == 0:
            return path.exists() and not path.is_file()
        with path.open("rb") as file:
            return b'name="generator" content="izoo.report"' not in file.read(4096)
    except OSError as error:
        raise IzooError(f"cannot read {path}: {os_reason(error)}; choose another place with out=FILE.") from error


def render(material: Material, *, replay: bool = True, imports: bool = False, note: Note = lambda _: None) -> str:
    """Return the page of collected results."""
    scored = []
    for entry in material.entries:
        note(f"Scoring {entry.name}: {counted(len(entry.runs), 'run')}.")
        scored.append(score(entry))
    played, lost = _replays(scored, imports, note) if replay else ([], [])
    drawn = figures.figures(material, scored)
    content = {
        "figures": {figure.name: dataclasses.asdict(figure) for part in drawn.values() for figure in part},
        "rows": approach_rows(scored),
        "columns": [dataclasses.asdict(column) for column in COLUMNS],
        "features": FEATURES,
        "colours": drawing.colours(scored),
        "scenes": [scene for scene, _ in played],
    }
    environment = Environment(
        loader=PackageLoader("izoo.reporting", TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html").render(
        title=material.title,
        version=__version__,
        material=material,
        intro=_intro(material, scored),
        not_driven=[nan_in_words(s.name, s.nan_share) for s in scored if s.nan_share],
        summary=[row for s in scored for row in _summary_rows(s)],
        summary_columns=[label for label, _, _ in SUMMARY_COLUMNS],
        scores=_scores(scored),
        improvement=_improvement(scored),
        electric=any(drives_electric(s.entry.runs[0].table, s.entry.policy) for s in scored),
        saturated=_named(scored, "saturated"),
        left_out=_named(scored, "left_out"),
        figures=drawn,
        published=PUBLISHED,
        ours=[_beside(s) for s in scored],
        tradeoffs=_tradeoff_table(material.tradeoffs),
        lost=lost,
        style=_asset("style.css"),
        script="\n".join(_asset(name) for name in SCRIPTS),
        plotly=_pack(get_plotlyjs().encode()),
        content=_pack(_json(content)),
        replays=[base64.b64encode(packed).decode() for _, packed in played],
    )


def _replays(scored: Sequence[Scored], imports: bool, note: Note) -> tuple[list[tuple[dict[str, Any], bytes]], list]:
    """Replays of the best policies, in the page's order, and why others are missing."""
    played: list[tuple[dict[str, Any], bytes]] = []
    lost: list[tuple[str, str]] = []
    # Weights before training are kept nowhere, and nobody wants to see them drive.
    able = [s for s in scored if s.entry.policy != UNCOMMANDED and not s.untrained] or list(scored)
    ranked = sorted(able, key=lambda s: -(s.summary["all"]["exact"]["mean"]["value"] or 0.0))
    if ranked[REPLAY_POLICIES:]:
        names = ", ".join(s.name for s in ranked[REPLAY_POLICIES:])
        lost.append((names, f"only the {REPLAY_POLICIES} policies with the highest mean benefit are replayed."))
    with Player(imports) as player:
        for s in (s for s in able if s.name in {kept.name for kept in ranked[:REPLAY_POLICIES]}):
            for scene in scenes(s):
                try:
                    packed = player.replay(scene, note)
                except (IzooError, OSError) as error:
                    text = str(error).replace(str(scene.run.folder), scene.run.folder.name)
                    lost.append((s.name, text))
                    note(f"No replay of {s.name}: {text}")
                    break
                if sum(len(other) for _, other in played) + len(packed) > REPLAY_BYTES:
                    lost.append((s.name, f"the {scene.which} approach would make the page too large."))
                    continue
                described = dataclasses.asdict(dataclasses.replace(scene, run=None))  # type: ignore[arg-type]
                described |= {"name": s.name, "seed": str(scene.seed), "runs": len(s.tables)}
                played.append((described, packed))
    return played, lost


def _intro(material: Material, scored: Sequence[Scored]) -> str:
    if not scored:
        return "No evaluation yet: learning curves only. Evaluate the run with python -m izoo.evaluate run=RUN."
    tables = [run.table for s in scored for run in s.entry.runs]
    pairs = pd.concat([t[["context_hash", "approach", "intersection", "seed", "policy"]] for t in tables])
    approaches = len(pairs[["context_hash", "approach"]].drop_duplicates())
    seeds = sorted({seeds_per_context(table) for table in tables})
    paired = f"{seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else f"{seeds[0]}"
    text = f"{approaches} approaches on {pairs['intersection'].nunique()} intersections, {paired} paired seeds each. "
    places = [counted_intersections(s.rows) for s in scored]
    return text + intervals_in_words(places, [len(s.tables) for s in scored if s.trained])


def _summary_rows(scored: Scored) -> list[dict[str, Any]]:
    """Lines of the summary table: all approaches, those without saturation, and the best of several seeds."""
    runs = len(scored.tables)
    nan = f"{100.0 * scored.nan_share:.3g} % of its commands NaN" if scored.nan_share else ""
    variants = [(nan, scored.summary["all"])]
    if scored.summary["saturated"]:
        variants.append(("without saturated", scored.summary["unsaturated"]))
    if scored.best_summary is not None:
        variants.append((f"best of {runs} seeds (the paper's form)", scored.best_summary["all"]))
    rows = []
    for variant, block in variants:
        count = block["exact"]["mean"]["n"]
        best = variant.startswith("best")
        rows.append(
            {
                "name": scored.name,
                "variant": variant,
                "runs": 1 if best else runs,
                "n": count,
                "cells": [
                    _cell(block[part][statistic]) if part in block else None for _, part, statistic in SUMMARY_COLUMNS
                ],
                "quiet": scored.entry.policy == UNCOMMANDED or variant not in ("", nan),
            }
        )
    return rows


def _cell(estimate: dict[str, Any]) -> dict[str, str]:
    value, _, interval = percent(estimate).partition(" [")
    return {"value": value, "interval": f"[{interval}" if interval else ""}


def _scores(scored: Sequence[Scored]) -> list[tuple[list[str], list[list[str]]]]:
    """Per test, header and lines of every measured quantity; of several training seeds the mean over them.

    Policies of a test stand beside each other over the episodes that all of them have. One that shares none with
    those before it begins a table of its own.
    """
    groups: list[tuple[list[Scored], pd.Index]] = []
    for s in scored:
        played = _episodes(s)
        for k, (group, shared) in enumerate(groups):
            common = shared.intersection(played)
            if group[0].entry.test == s.entry.test and len(common):
                groups[k] = ([*group, s], common)
                break
        else:
            groups.append(([s], played))
    several = len({s.entry.test for s in scored}) > 1
    tables = []
    for group, shared in groups:
        parts = {HUMAN: _parts(group[0], HUMAN)[:1], **{s.name: _parts(s, s.entry.policy) for s in group}}
        pooled = {name: _pooled([part.loc[shared] for part in rows]) for name, rows in parts.items() if len(shared)}
        header, lines = score_rows({"scores": pooled})
        tables.append(([group[0].entry.test if several else "", *header[1:]], lines))
    return tables


def _parts(scored: Scored, policy: str) -> list[pd.DataFrame]:
    """Rows of a policy in every run, by episode and approach."""
    return [run.table[run.table["policy"] == policy].set_index(list(PAIR)) for run in scored.entry.runs]


def _episodes(scored: Scored) -> pd.Index:
    """What a policy has played in all of its runs, and human driving too."""
    parts = [*_parts(scored, scored.entry.policy), _parts(scored, HUMAN)[0]]
    return functools.reduce(pd.Index.intersection, [part.index for part in parts])


def _pooled(parts: Sequence[pd.DataFrame]) -> dict[str, Any]:
    return summarise(pd.concat(parts).reset_index().assign(policy=HUMAN))["scores"][HUMAN]


def _improvement(scored: Sequence[Scored]) -> list[dict[str, Any]]:
    """Rows of the matrix of probabilities of improvement; ``None`` on the diagonal and where nothing is common."""
    rows = []
    for x in scored:
        cells: list[dict[str, Any] | None] = []
        for y in scored:
            estimate = None if x is y else improvement(x, y)
            cells.append(None if estimate is None else {**estimate.to_dict(), "shade": round(estimate.value, 3)})
        rows.append({"name": x.name, "cells": cells})
    return rows if len(scored) > 1 else []


def _named(scored: Sequence[Scored], key: str) -> list[str]:
    return list(dict.fromkeys(name for s in scored for name in s.summary[key]))


def _beside(scored: Scored) -> dict[str, Any]:
    block = scored.summary["all"]
    values = scored.matrix("benefit_exact").to_numpy().ravel()
    return {
        "name": scored.name,
        "n": values.size,
        "at_zero": histograms.zero_count(values),
        "benefit": _cell(block["exact"]["ratio_of_sums"]),
        "throughput": _cell(block["throughput"]["ratio_of_sums"]),
        "kept": _cell(block["throughput"]["share_kept"]),
    }


def _tradeoff_table(table: pd.DataFrame | None) -> dict[str, Any]:
    if table is None:
        return {"header": [], "lines": []}

    def word(value: Any) -> str:
        return "" if pd.isna(value) else f"{value:.4g}" if isinstance(value, float) else str(value)

    lines = [[word(value) for value in row] for row in table.itertuples(index=False)]
    return {"header": [name.replace("_", " ") for name in table.columns], "lines": lines}


def _asset(name: str) -> str:
    return (resources.files("izoo.reporting") / TEMPLATES / name).read_text(encoding="utf-8")


def _pack(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode()


def _json(content: Any) -> bytes:
    """JSON without NaN, which JSON does not have."""
    return json.dumps(_plain(content), separators=(",", ":"), allow_nan=False).encode()


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
