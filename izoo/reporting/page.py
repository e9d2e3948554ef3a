"""One self-contained HTML page from an evaluation's folder: figures, aggregates, and a sortable table of approaches."""

from __future__ import annotations

import html
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pandas as pd

from izoo.errors import IzooError
from izoo.evaluation import approach_table, summarise
from izoo.evaluation.policies import HUMAN
from izoo.evaluation.show import comparison_rows, score_rows
from izoo.evaluation.table import CSV_FILE, FEATURES, read_csv, write_text
from izoo.reporting import figures
from izoo.reporting.assets import SCRIPT, STYLE
from izoo.reporting.published import PUBLISHED

PAGE_FILE = "report.html"
APPROACH_COLUMNS = {
    "context": "context",
    "approach": "approach",
    "benefit_exact": "benefit, exact gate (%)",
    "benefit_tested": "benefit, tested gate (%)",
    "benefit_ungated": "without gate (%)",
    "low": "low (%)",
    "high": "high (%)",
    "throughput_benefit": "throughput (%)",
    "emission_policy_g": "g per vehicle",
    "emission_baseline_g": "baseline g per vehicle",
    "throughput_policy": "crossed",
    "throughput_baseline": "baseline crossed",
    "unfinished_policy": "unfinished",
    "unfinished_baseline": "baseline unfinished",
    "saturated": "saturated",
    "seeds": "seeds",
    "left_out": "left out",
}
_PERCENT = ("benefit_exact", "benefit_tested", "benefit_ungated", "low", "high", "throughput_benefit")


def write_report(results: Path, out: Path | None = None, title: str | None = None) -> Path:
    """Write the page of an evaluation.

    Args:
        results: folder with an ``evaluation.csv``.
        out: the page; ``None``: ``report.html`` in that folder.
        title: of the page; ``None``: the folder's name.

    Returns:
        the page's path.

    Raises:
        IzooError: there is no evaluation in the folder.
    """
    if not (results / CSV_FILE).is_file():
        raise IzooError(f"{results} has no {CSV_FILE}; give a folder that python -m izoo.evaluate has written.")
    path = out or results / PAGE_FILE
    text = render(read_csv(results / CSV_FILE), title or results.resolve().name)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
    except OSError as error:
        raise IzooError(f"cannot write {path}: {error.strerror}; choose another place with --out.") from error
    return path


def render(table: pd.DataFrame, title: str) -> str:
    """Return the page of an evaluation table."""
    summary = summarise(table)
    n = summary["n"]
    intro = f"{n['contexts']} contexts on {n['intersections']} intersections, {n['seeds']} paired seeds, "
    intro += f"{n['episodes']} episodes. Brackets are 95 % bootstrap intervals over intersections."
    header, lines = score_rows(summary)
    body = [f"<h1>{html.escape(title)}</h1><p>{intro}</p>", "<h2>Scores</h2>", _table(header, lines)]
    for name, policy in summary["policies"].items():
        baseline = policy["headline"]
        body.append(f"<h2>{html.escape(name)}</h2>")
        body += [_comparison(name, other, block) for other, block in policy["against"].items()]
        body.append(_approaches(table, name, baseline, title))
    body += ["<h2>Published figures</h2>", _published()]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head>"
        f"<body><main>{''.join(body)}</main><script>{SCRIPT}</script></body></html>\n"
    )


def _comparison(name: str, baseline: str, block: dict[str, Any]) -> str:
    header, lines = comparison_rows(block)
    notes = ""
    for key, words in (("saturated", "saturated"), ("left_out", "left out")):
        named = ", ".join(block[key][:5]) + (" ..." if len(block[key]) > 5 else "")
        notes += f"<p>{len(block[key])} {words}: {html.escape(named)}</p>" if block[key] else ""
    return f"<h3>{html.escape(name)} against {html.escape(baseline)}</h3>{_table(header, lines)}{notes}"


def _approaches(table: pd.DataFrame, name: str, baseline: str, title: str) -> str:
    """Histogram, scatter plots and the sortable table of one policy."""
    result = approach_table(table, name, baseline)
    described = table[table["policy"] == name].drop_duplicates(["context_hash", "approach"])
    extra = [column for column in FEATURES if column not in result]
    result = result.merge(described[["context_hash", "approach", *extra]], on=["context_hash", "approach"])
    counted = result[result["left_out"] == ""]
    parts = []
    if len(counted):
        parts.append(f"<figure>{figures.histogram(counted['benefit_exact'], f'{name}: {title}')}</figure>")
        parts.append(f"<figure>{figures.scatter(counted, tuple(figures.FEATURES))}</figure>")
    shown = result[list(APPROACH_COLUMNS)].copy()
    shown[list(_PERCENT)] *= 100.0
    lines = [[_cell(value) for value in row] for row in shown.itertuples(index=False)]
    label = f"Approaches, against {baseline}" if baseline != HUMAN else "Approaches, against human driving"
    parts.append(f"<h3>{label}</h3>{_table(APPROACH_COLUMNS.values(), lines, sortable=True)}")
    return "".join(parts)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "" if pd.isna(value) else f"{value + 0.0:.2f}"
    if isinstance(value, bool):
        return "yes" if value else ""
    return str(value)


def _published() -> str:
    header = ("protocol", "algorithm", "benefit, ratio of sums", "throughput benefit", "throughput kept")
    lines = [
        [p.protocol, p.algorithm, *(f"{100 * v:.2f} %" for v in (p.benefit, p.throughput_benefit, p.throughput_kept))]
        for p in PUBLISHED
    ]
    note = "<p>From arXiv 2410.15221, adoption 1/3. Only the ratio of sums above compares with them.</p>"
    return _table(header, lines) + note


def _table(header: Iterable[str], lines: Iterable[Iterable[str]], sortable: bool = False) -> str:
    tag = '<button type="button">{}</button>' if sortable else "{}"
    head = "".join(f"<th>{tag.format(html.escape(word))}</th>" for word in header)
    rows = "".join(f"<tr>{''.join(f'<td>{html.escape(word)}</td>' for word in line)}</tr>" for line in lines)
    kind = ' class="sortable"' if sortable else ""
    return f'<div class="wide"><table{kind}><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
