"""Movements and the map of a town on the report's page."""

import dataclasses
from pathlib import Path

import numpy as np

from izoo.contexts.procedural import procedural_context
from izoo.envs.mdp.metric_sums import MOVEMENT_METRICS
from izoo.report.movements import movements_table, town_maps
from izoo.report.page import write_report
from izoo.report.report_data import collect
from izoo.results.store import add_contexts, read_contexts
from tests.report.made_tables import folder, table


def test_the_page_lists_movements_and_maps_a_town(tmp_path: Path) -> None:
    results = folder(tmp_path / "results", table({"ppo": (0.05, 2.0, 1)}, places=3))
    context = procedural_context()
    for place in range(3):
        spec = dataclasses.replace(context.intersection, name=f"town/{place}", lonlat=(0.001 * place, 47.0))
        add_contexts(results, [context.replace(intersection=spec)])
    assert {context.intersection.lonlat for context in read_contexts(results).values()} == {
        (0.001 * place, 47.0) for place in range(3)
    }
    evaluation = collect(results).evaluations[0]
    shown = movements_table(evaluation)
    assert shown is not None and [name for name, _ in shown.groups] == ["town/0", "town/1", "town/2"]
    assert [row.label for row in shown.groups[0][1]] == ["all", "A right", "A straight", "A left"]
    assert len(shown.columns) == 3 + 3 * 3 == 1 + len(shown.rows[0].cells)
    maps = town_maps(evaluation)
    assert len(maps) == 3 and "town/2 A, 1 s" in maps[0][1]
    page = write_report(results, replay=False).read_text()
    assert "Highway Capacity Manual" in page and page.count("data:image/png;base64") == 3


def test_rows_without_sums_by_movement_leave_the_section_out(tmp_path: Path) -> None:
    made = table({"ppo": (0.05, 2.0, 1)}, places=3)
    made[list(MOVEMENT_METRICS)] = np.nan
    results = folder(tmp_path / "results", made)
    assert movements_table(collect(results).evaluations[0]) is None
    assert "Highway Capacity Manual" not in write_report(results, replay=False).read_text()
