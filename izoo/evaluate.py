"""``python -m izoo.evaluate``: compare a policy with human driving, episode by episode."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from izoo import cli


def _config() -> type:
    from izoo.conf.evaluate_options import EvaluateConfig

    return EvaluateConfig


def _work() -> cli.Work:
    from izoo.commands.evaluating import evaluate

    return evaluate


COMMAND = cli.Command(
    name="evaluate",
    summary="Compare a policy with human driving on the same episodes, and say what it saves.",
    examples=(
        "izoo.evaluate run=runs/RUN",
        "izoo.evaluate run=runs/RUN contexts=dataset contexts.path=DATASET seeds=5 num_workers=8",
        "izoo.evaluate policy=glide contexts=pcg num_contexts=32",
        "izoo.evaluate policy=my_package.drivers:calm out=results/calm",
    ),
    config=_config,
    work=_work,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    return cli.run(COMMAND, argv)


if __name__ == "__main__":
    sys.exit(main())
