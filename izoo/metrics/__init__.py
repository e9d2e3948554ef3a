"""From the sums that an environment emits to numbers with intervals.

- :mod:`~izoo.metrics.definitions`: what an environment reports.
- :mod:`~izoo.metrics.masked`: reductions over valid slots.
- :mod:`~izoo.metrics.scores`: scores per vehicle.
- :mod:`~izoo.metrics.benefit`: benefit against human driving, paired and gated.
- :mod:`~izoo.metrics.statistics`: aggregates with confidence intervals.
- :mod:`~izoo.metrics.student`: the distribution that they rest on.
"""
