"""Room: evaluation. Runs policies against human driving on the same episodes, and sums up.

- :func:`evaluate_policy`: paired episodes over worker processes, resumable, baselines cached.
- :func:`summarise`, :func:`print_summary`: aggregates with intervals, as a dictionary and as a table to read.
- :func:`approach_table`: the benefit of every approach, with its interval.
"""

from izoo.evaluation.runner import evaluate_policy
from izoo.evaluation.show import print_summary
from izoo.evaluation.summary import approach_table, summarise

__all__ = ["approach_table", "evaluate_policy", "print_summary", "summarise"]
