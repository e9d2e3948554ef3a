"""What ``python -m izoo.train`` does once its options are known."""

from __future__ import annotations

from pathlib import Path

from izoo.conf.train_options import TrainConfig
from izoo.report.tables import print_summary
from izoo.training import loop


def train(config: TrainConfig) -> Path:
    """Train as :func:`izoo.training.loop.train` does, and print the comparison that ends the run."""
    return loop.train(config, print_summary)
