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
    defaults="izoo.cli.defaults:of_policies",
)
main = COMMAND.main


def load(folder: Path | str) -> TensorDictBase:
    """Read a collected data set into memory.

    Args:
        folder: what ``out=`` named.

    Returns:
        Steps ``[frames]``, in the order of collection: environment after environment within a time step. They are in
        memory, with their empty slots; :func:`replay_buffer`, where steps that follow each other stand beside each
        other, reads only what it samples.

    Raises:
        IzooError: the folder is not a data set of izoo, or not whole.
    """
    from izoo.training.stored_steps import open_steps

    return open_steps(folder).collected()


def replay_buffer(folder: Path | str, **options: Any) -> TensorDictReplayBuffer:
    """Open a data set as a read-only replay buffer, memory-mapped, without copying.

    It holds the steps of one environment after those of another, each in the order of time, so that TorchRL's
    ``SliceSampler`` draws slices of episodes, once it is told which step is of which (:func:`trajectories`).

    Args:
        folder: what ``out=`` named.
        options: of :class:`torchrl.data.TensorDictReplayBuffer`, such as ``batch_size``, ``sampler`` or ``transform``.
    """
    from torchrl.data import ImmutableDatasetWriter, TensorDictReplayBuffer

    from izoo.training.stored_steps import as_they_are, open_steps

    return TensorDictReplayBuffer(
        storage=open_steps(folder), writer=ImmutableDatasetWriter(), collate_fn=as_they_are, **options
    )


def trajectories(folder: Path | str) -> Tensor:
    """Return numbers of the episodes that the steps of :func:`replay_buffer` are of, ``[frames]``.

    For ``SliceSampler(slice_len=20, trajectories=trajectories(folder), cache_values=True)``: with the name of a key
    instead, it reads the whole data set for every batch.
    """
    from izoo.training.stored_steps import open_steps

    return open_steps(folder).leaf(("collector", "traj_ids"))


if __name__ == "__main__":
    sys.exit(main())
