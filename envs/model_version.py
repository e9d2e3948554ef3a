"""The number of what the environments simulate and count."""

from __future__ import annotations

MODEL_VERSION = 1
"""Results of different numbers are not compared. Raised by hand whenever an episode of the same context, seed and
commands comes out otherwise: other trajectories, other CO2, or other sums. ``tests/envs/test_model_version.py`` notices
that, and says what to do."""
