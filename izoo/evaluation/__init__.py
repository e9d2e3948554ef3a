"""Runs policies against human driving on the same episodes, and sums up.

- :func:`evaluate_policy`: paired episodes over worker processes, resumable, baselines cached.
- :func:`summarise`, :func:`print_summary`: aggregates with intervals, as a dictionary and as a table to read.
- :func:`approach_table`: the benefit of every approach, with its interval.

Names are loaded when first used, so that commands answer before PyTorch is loaded.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from izoo.evaluation.runner import evaluate_policy
    from izoo.evaluation.show import print_summary
    from izoo.evaluation.summary import approach_table, summarise

_HOME = {"approach_table": "summary", "evaluate_policy": "runner", "print_summary": "show", "summarise": "summary"}
__all__ = ["approach_table", "evaluate_policy", "print_summary", "summarise"]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
