"""``python -m izoo.collect``: store what a policy experiences as memory-mapped TensorDicts; :func:`load` and
:func:`replay_buffer` open them.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from izoo.cli.option_command import OptionCommand

if TYPE_CHECKING:
    from tensordict import TensorDictBase
    from torch import Tensor
    from torchrl.data import TensorDictReplayBuffer

COMMAND = OptionCommand(
    name="collect",
    summary="Store what a policy experiences as a memory-mapped TensorDict, for offline learning.",
    examples=(
        "izoo.collect policy=random frames=20000 out=DIR",
        "izoo.collect policy=runs/RUN frames=100000 out=DIR contexts=dataset contexts.path=DATASET",
    ),
    config="izoo.conf.train_options:CollectConfig",
    work="izoo.training.offline:collect",
)
main = COMMAND.main


def load(folder: Path | str) -> TensorDictBase:
    """Read a collected data set into memory.

    Args:
        folder: what ``out=`` named.

    Returns:
        steps ``[frames]``; see :func:`izoo.training.dataset.load`.
    """
    from izoo.training.dataset import load as load_dataset

    return load_dataset(folder)


def replay_buffer(folder: Path | str, **options: Any) -> TensorDictReplayBuffer:
    """Open a collected data set as one read-only replay buffer, however many shards it has, without copying.

    Args:
        folder: what ``out=`` named.
        options: of :class:`torchrl.data.TensorDictReplayBuffer`: ``replay_buffer(folder, batch_size=256)``.

    Returns:
        A buffer of ``frames`` steps; what it samples is read from the memory-mapped shards.
    """
    from izoo.training.dataset import replay_buffer as open_buffer

    return open_buffer(folder, **options)


def trajectories(folder: Path | str) -> Tensor:
    """Return numbers of the episodes that the steps of :func:`replay_buffer` are of, ``[frames]``.

    ``SliceSampler(slice_len=20, trajectories=trajectories(folder), cache_values=True)`` draws slices of episodes.
    """
    from izoo.training.dataset import trajectories as read_trajectories

    return read_trajectories(folder)


if __name__ == "__main__":
    sys.exit(main())
