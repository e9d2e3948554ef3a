"""The table: episodes of policies and baselines, played, kept and read back.

- :func:`evaluate_policy`: play a policy and its baselines; return the table.
- :func:`summarise`, :func:`print_summary`: what a table says, as a dictionary and as tables to read.
- :func:`read_table`: the table of a results folder.

A row is one approach of one episode of one policy (:mod:`izoo.results.schema`). Names are loaded when first used, so
that commands answer before PyTorch is loaded.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from izoo.metrics.summary import summarise
    from izoo.results.rollout import evaluate_policy
    from izoo.results.store import read_table

_HOME = {
    "evaluate_policy": "izoo.results.rollout",
    "print_summary": "izoo.report.tables",
    "read_table": "izoo.results.store",
    "summarise": "izoo.metrics.summary",
}
__all__ = ["evaluate_policy", "print_summary", "read_table", "summarise"]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)
