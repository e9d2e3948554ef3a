"""One and two vehicles alone on the net of a context, in SUMO and on the twin: the formulas of driving."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from izoo.benchmarks.oracle import Case, first_departure, play_sumo, play_twin, waves
from izoo.console import Progress
from izoo.contexts.context import Context
from izoo.evaluation.selection import EpisodeSeeds
from izoo.files import write_text

HORIZON_S = 300.0
TOLERANCE = 1e-6
"""Positions and speeds (m, m/s) that differ by no more are the same."""
PLAYS = ((1, False), (2, False), (2, True))
"""How many vehicles, and whether their speeds are commanded, in waves."""


def compare_few(contexts: Sequence[Context], seeds: EpisodeSeeds, path: Path) -> pd.DataFrame:
    """Play the first vehicles of each context alone, unless they are in the table at ``path``.

    Returns:
        ``context``, ``context_hash``, ``seed``, ``vehicles``, ``commanded``, ``parted`` (the first step that differs
        by more than :data:`TOLERANCE`; empty where none does), ``where`` (who differs there).
    """
    table = pd.read_csv(path, dtype={"parted": "Int64"}) if path.exists() else pd.DataFrame()
    rows: list[dict[str, Any]] = table.to_dict("records")
    done = {(row["context_hash"], row["seed"], row["vehicles"], row["commanded"]) for row in rows}
    plays = [(c, seeds.of(c)[0], count, commanded) for c, (count, commanded) in itertools.product(contexts, PLAYS)]
    todo = [play for play in plays if (play[0].content_hash, *play[1:]) not in done]
    if not todo:
        return table
    with Progress(len(todo), unit="episodes", file=sys.stderr) as bar:
        for number, (context, seed, count, commanded) in enumerate(todo, 1):
            case = Case.of(context, seed, HORIZON_S).first(count)
            if len(case.traffic) < count:
                continue
            steps = round(1000.0 * HORIZON_S / case.step_ms)
            sumo, twin = (play(case, steps, waves if commanded else None) for play in (play_sumo, play_twin))
            found = first_departure(case, sumo, twin, TOLERANCE)
            rows.append(
                {
                    "context": context.name,
                    "context_hash": context.content_hash,
                    "seed": seed,
                    "vehicles": count,
                    "commanded": commanded,
                    "parted": None if found is None else found.step,
                    "where": "" if found is None else str(found),
                }
            )
            write_text(path, pd.DataFrame(rows).astype({"parted": "Int64"}).to_csv(index=False))
            bar.update(number, context.name)
    return pd.DataFrame(rows).astype({"parted": "Int64"})
