"""One and two vehicles alone on the net of a context, in SUMO and on the twin: the formulas of driving."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from izoo.benchmarks.fidelity.single_vehicle import Case, first_departure, play_sumo, play_twin, waves
from izoo.contexts.context import Context
from izoo.results.rows_file import Key, Row, RowsFile
from izoo.results.selection import EpisodeSeeds

HORIZON_S = 300.0
TOLERANCE = 1e-6
"""Positions and speeds (m, m/s) that differ by no more are the same."""
PLAYS = ((1, False), (2, False), (2, True))
"""How many vehicles, and whether their speeds are commanded, in waves."""
KEY = ("context_hash", "seed", "step_s", "vehicles", "commanded")
TEXT, NUMBERS = ("context_hash", "where"), ("seed", "step_s", "vehicles", "commanded", "parted")


def compare_few(contexts: Sequence[Context], seeds: EpisodeSeeds, step_s: float, kept: RowsFile) -> list[Row]:
    """Play the first vehicles of each context alone, unless the file has them; return a row for each play.

    A context with fewer vehicles has fewer rows. ``parted`` is the first step that differs by more than
    :data:`TOLERANCE`, missing where none does; ``where`` is the vehicle that differs there.
    """
    plays = {
        (context.content_hash, seeds.of(context)[0], step_s, *kind): context
        for context, kind in itertools.product(contexts, PLAYS)
    }

    def compare(key: Key, context: Context) -> list[Row]:
        _, seed, _, count, commanded = key
        case = Case.of(context, seed, HORIZON_S, round(1000.0 * step_s)).first(count)
        if len(case.traffic) < count:
            return []
        steps = round(HORIZON_S / step_s)
        sumo, twin = (play(case, steps, waves if commanded else None) for play in (play_sumo, play_twin))
        found = first_departure(case, sumo, twin, TOLERANCE)
        return [{"parted": None if found is None else found.step, "where": None if found is None else str(found)}]

    return kept.fill(KEY, plays, compare)
