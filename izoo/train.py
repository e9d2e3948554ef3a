"""``python -m izoo.train``: train a policy on eco-driving contexts and compare it with human driving."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from izoo import cli


def _config() -> type:
    from izoo.conf.options import TrainConfig

    return TrainConfig


def _work() -> cli.Work:
    from izoo.training.loop import train

    return train


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
    config=_config,
    work=_work,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    return cli.run(COMMAND, argv)


if __name__ == "__main__":
    sys.exit(main())
