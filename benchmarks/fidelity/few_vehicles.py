"""One and two vehicles alone on the net of a context, in SUMO and on the twin: the formulas of driving."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence

import pandas as pd

from izoo.benchmarks.fidelity.journal import Journal
from izoo.benchmarks.fidelity.single_vehicle import Case, first_departure, play_sumo, play_twin, waves
from izoo.console import Progress
from izoo.contexts.context import Context
from izoo.results.selection import EpisodeSeeds

HORIZON_S = 300.0
TOLERANCE = 1e-6
"""Positions and speeds (m, m/s) that differ by no more are the same."""
PLAYS = ((1, False), (2, False), (2, True))
"""How many vehicles, and whether their speeds are commanded, in waves."""


def compare_few(contexts: Sequence[Context], seeds: EpisodeSeeds, step_s: float, kept: Journal) -> pd.DataFrame:
    """Play the first vehicles of each context alone, unless the journal has them.

    A context with fewer vehicles has fewer rows.

    Returns:
        ``vehicles``, ``commanded``, ``parted`` (the first step that differs by more than :data:`TOLERANCE`; missing
        where none does), ``where`` (the vehicle that differs there).
    """
    plays = {
        ("few", context.content_hash, seeds.of(context)[0], step_s, *kind): context
        for context, kind in itertools.product(contexts, PLAYS)
    }
    todo = [key for key in plays if key not in kept.rows]
    with Progress(len(todo), unit="episodes", file=sys.stderr) as bar:
        for number, key in enumerate(todo, 1):
            context, (*_, seed, _, count, commanded) = plays[key], key
            case = Case.of(context, seed, HORIZON_S, round(1000.0 * step_s)).first(count)
            if len(case.traffic) == count:
                steps = round(HORIZON_S / step_s)
                sumo, twin = (play(case, steps, waves if commanded else None) for play in (play_sumo, play_twin))
                found = first_departure(case, sumo, twin, TOLERANCE)
                parted, where = (None, "") if found is None else (found.step, str(found))
                kept.add(key, {"vehicles": count, "commanded": commanded, "parted": parted, "where": where})
            bar.update(number, context.name)
    return kept.table(plays)
