"""What a report says of movements: delay, level of service and queues, and a map of a town with its levels."""

from __future__ import annotations

import base64
import io

import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg

from izoo.errors import IzooError
from izoo.metrics.cell import Cell
from izoo.metrics.level_of_service import MOST_DELAY_S, by_intersection, by_movement
from izoo.metrics.pairing import BASELINES, HUMAN, UNCOMMANDED
from izoo.networks.draw.town import draw_town
from izoo.report.report_data import Evaluation
from izoo.report.tables import Row, Table, ranking
from izoo.results.store import read_contexts

MOST_INTERSECTIONS = 60
"""Movements of more intersections are not listed."""
COLOURS = dict(zip(MOST_DELAY_S, ("#1a9850", "#91cf60", "#c9b400", "#f39c12", "#e05c2b", "#a50026"), strict=True))


def shown_policies(evaluation: Evaluation) -> list[str]:
    """Return human driving, uncommanded, and the entry that saves most."""
    best = [name for name in ranking(evaluation.summary) if name not in BASELINES]
    return [HUMAN, UNCOMMANDED, *best[:1]]


def movements_table(evaluation: Evaluation) -> Table | None:
    """Return a row per movement, by intersection; ``None`` without sums by movement, or of too many intersections."""
    found = {name: by_movement(evaluation.table, name) for name in shown_policies(evaluation)}
    reference = found[HUMAN]
    towns = list(dict.fromkeys(reference.index.get_level_values("intersection")))
    if not 0 < len(towns) <= MOST_INTERSECTIONS:
        return None
    whole = {name: by_intersection(rows) for name, rows in found.items()}
    groups = []
    for town in towns:
        rows = [Row("all", ("", "", *(cell for part in whole.values() for cell in _cells(part, town))))]
        for place, movement in reference.loc[town].index:
            key, row = (town, place, movement), reference.loc[(town, place, movement)]
            cells = (cell for part in found.values() for cell in _cells(part, key))
            volumes = Cell(row["vehicles"], digits=1), Cell(row["volume_over_capacity"], digits=2)
            rows.append(Row(f"{place} {movement}", (*volumes, *cells)))
        groups.append((town, tuple(rows)))
    headings = [
        f"{name}: {what}" for name in found for what in ("control delay, level", "blocked outside", "longest queue")
    ]
    columns = ("movement", "vehicles per episode", "volume over capacity of the approach", *headings)
    return Table("Movements", columns, tuple(groups))


def _cells(part: pd.DataFrame, key: object) -> tuple[Cell | str, ...]:
    if key not in part.index:
        return "-", "-", "-"
    row = part.loc[key]
    queue: Cell | str = ""
    if "queue_max" in part:
        queue = Cell(row["queue_max"], unit="veh", note=f"{row['queue']:.1f} at the horizon")
    return Cell(row["delay_s"], unit="s", note=row["level"]), Cell(row["blocked_s"], unit="s"), queue


def town_maps(evaluation: Evaluation) -> list[tuple[str, str]]:
    """Return a map per shown policy, as a PNG in base64 and in words; none where places are not known."""
    try:
        contexts = read_contexts(evaluation.folder).values()
    except IzooError:
        return []
    specs = {context.intersection.name: context.intersection for context in contexts if context.intersection.lonlat}
    maps = []
    for policy in shown_policies(evaluation):
        levels = by_intersection(by_movement(evaluation.table, policy))
        here = [specs[name] for name in levels.index if name in specs]
        if not here:
            continue
        words = {name: f"{row['level']}, {row['delay_s']:.0f} s" for name, row in levels.iterrows()}
        colours = {name: COLOURS[level] for name, level in levels["level"].items()}
        figure = draw_town(here, f"Level of service, {policy}", words, colours, COLOURS)
        picture = io.BytesIO()
        FigureCanvasAgg(figure).print_figure(picture, dpi=90, facecolor="white", format="png")
        alt = "; ".join(f"{spec.name} {words[spec.name]}" for spec in here)
        maps.append((base64.b64encode(picture.getvalue()).decode(), f"Level of service, {policy}: {alt}."))
    return maps
