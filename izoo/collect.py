"""``python -m izoo.collect``: store what a policy experiences as memory-mapped TensorDicts; :func:`load` and
:func:`replay_buffer` open them.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from izoo import cli

if TYPE_CHECKING:
    from tensordict import TensorDictBase
    from torchrl.data import TensorDictReplayBuffer


def load(folder: Path | str) -> TensorDictBase:
    """Open a collected data set without reading it into memory.

    Args:
        folder: what ``out=`` named.

    Returns:
        steps ``[frames]``, memory-mapped; see :func:`izoo.training.offline.load`.
    """
    from izoo.training.offline import load as load_dataset

    return load_dataset(folder)


def replay_buffer(folder: Path | str, **options: Any) -> TensorDictReplayBuffer:
    """Open a collected data set as one read-only replay buffer, however many shards it has, without copying.

    Args:
        folder: what ``out=`` named.
        options: of :class:`torchrl.data.TensorDictReplayBuffer`: ``replay_buffer(folder, batch_size=256)``.

    Returns:
        A buffer of ``frames`` steps; what it samples is read from the memory-mapped shards.
    """
    from izoo.training.offline import replay_buffer as open_buffer

    return open_buffer(folder, **options)


def _config() -> type:
    from izoo.conf.options import CollectConfig

    return CollectConfig


def _work() -> cli.Work:
    from izoo.training.offline import collect

    return collect


COMMAND = cli.Command(
    name="collect",
    summary="Store what a policy experiences as a memory-mapped TensorDict, for offline learning.",
    examples=(
        "izoo.collect policy=random frames=20000 out=DIR",
        "izoo.collect policy=runs/RUN frames=100000 out=DIR contexts=dataset contexts.path=DATASET",
    ),
    config=_config,
    work=_work,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    return cli.run(COMMAND, argv)


if __name__ == "__main__":
    sys.exit(main())
