"""From the sums that an environment emits to figures with intervals.

- :mod:`~izoo.metrics.figures`: the registry: every figure that is shown, declared once.
- :mod:`~izoo.metrics.cell`: a number as tables and sentences show it.
- :mod:`~izoo.metrics.pairing`: rows of a policy beside those of a baseline.
- :mod:`~izoo.metrics.statistics`: the headline with its interval, differences, corrections.
- :mod:`~izoo.metrics.summary`: what a table says, and a verdict.
- :mod:`~izoo.metrics.paper_form`: the measure of the published figures.
"""

REFERENCE = "sumo"
"""The simulator whose results count, where several have played."""
