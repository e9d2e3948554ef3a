"""``python -m izoo.train``: train a policy on eco-driving contexts and compare it with human driving."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

from izoo import cli


def _load() -> tuple[type, Callable[[Any, frozenset[str]], object]]:
    from izoo.conf.options import TrainConfig
    from izoo.training.session import train

    return TrainConfig, train


COMMAND = cli.Command(
    name="train",
    summary="Train a policy on eco-driving contexts, then compare it with human driving.",
    examples=(
        "izoo.train",
        "izoo.train contexts=pcg_easy total_frames=100000 seed=1",
        "izoo.train contexts=dataset contexts.path=DIR algo=ppo algo.lr=1e-4 num_workers=8",
        "izoo.train -m seed=0,1,2,3",
        "izoo.train resume=runs/RUN total_frames=500000",
    ),
    load=_load,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    return cli.run(COMMAND, argv)


if __name__ == "__main__":
    sys.exit(main())
