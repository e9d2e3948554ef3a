"""One and two vehicles alone on the net of a context, in SUMO and on the twin: the formulas of driving."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from izoo.benchmarks.kept_rows import KeptRows
from izoo.benchmarks.oracle import Case, first_departure, play_sumo, play_twin, waves
from izoo.console import Progress
from izoo.contexts.context import Context
from izoo.evaluation.selection import EpisodeSeeds

HORIZON_S = 300.0
TOLERANCE = 1e-6
"""Positions and speeds (m, m/s) that differ by no more are the same."""
PLAYS = ((1, False), (2, False), (2, True))
"""How many vehicles, and whether their speeds are commanded, in waves."""
KEY = ("context_hash", "seed", "step_s", "vehicles", "commanded")
COLUMNS = {
    **{"context": "str", "context_hash": "str", "seed": "int64", "step_s": "float", "vehicles": "int64"},
    **{"commanded": "bool", "parted": "Int64", "where": "str"},
}


def compare_few(contexts: Sequence[Context], seeds: EpisodeSeeds, step_s: float, path: Path) -> pd.DataFrame:
    """Play the first vehicles of each context alone, unless they are in the table at ``path``.

    A context with fewer vehicles has fewer rows.

    Returns:
        ``context``, ``context_hash``, ``seed``, ``step_s``, ``vehicles``, ``commanded``, ``parted`` (the first step
        that differs by more than :data:`TOLERANCE`; empty where none does), ``where`` (who differs there).
    """
    kept = KeptRows(path, COLUMNS, KEY)
    plays = {
        (context.content_hash, seeds.of(context)[0], step_s, *kind): context
        for context, kind in itertools.product(contexts, PLAYS)
    }
    todo = [key for key in plays if key not in kept]
    with Progress(len(todo), unit="episodes", file=sys.stderr) as bar:
        for number, key in enumerate(todo, 1):
            context, (_, seed, _, count, commanded) = plays[key], key
            case = Case.of(context, seed, HORIZON_S, round(1000.0 * step_s)).first(count)
            if len(case.traffic) == count:
                steps = round(HORIZON_S / step_s)
                sumo, twin = (play(case, steps, waves if commanded else None) for play in (play_sumo, play_twin))
                found = first_departure(case, sumo, twin, TOLERANCE)
                parted, where = (None, "") if found is None else (found.step, str(found))
                kept.add(dict(zip(COLUMNS, (context.name, *key, parted, where), strict=True)))
            bar.update(number, context.name)
    return kept.table(plays)
