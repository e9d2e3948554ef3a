"""Collected data sets, read whole or as they are sampled."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, TensorDictReplayBuffer

from izoo.conf.train_options import MAX_ENVS
from izoo.envs.config import MAX_AGENTS
from izoo.errors import IzooError, check_whole
from izoo.files import expanded, reading
from izoo.training.shard_writer import FORMAT, MANIFEST
from izoo.training.shards import Shard, ShardStorage, as_they_are, check_files


def load(folder: Path | str) -> TensorDictBase:
    """Read a collected data set.

    Returns:
        Steps ``[frames]``, in the order of collection: environment after environment within a time step. They are in
        memory, with their empty slots; :func:`replay_buffer`, where steps that follow each other stand beside each
        other, reads only what it samples.

    Raises:
        IzooError: the folder is not a finished data set of izoo, or a shard is missing.
    """
    return torch.cat([shard[:] for shard in load_shards(folder)])


def replay_buffer(folder: Path | str, **options: Any) -> TensorDictReplayBuffer:
    """Open a data set of any number of shards as a read-only replay buffer, memory-mapped, without copying.

    It holds the steps of one environment after those of another, each in the order of time, so that TorchRL's
    ``SliceSampler`` draws slices of episodes, once it is told which step is of which (:func:`trajectories`).

    Args:
        folder: what ``out=`` named.
        options: of :class:`torchrl.data.TensorDictReplayBuffer`, such as ``batch_size``, ``sampler`` or ``transform``.

    Raises:
        IzooError: the data set cannot be read, or an option is one that a data set determines.
    """
    ours = [name for name in ("storage", "writer", "collate_fn") if name in options]
    if ours:
        raise IzooError(
            f"replay_buffer() takes no {', '.join(ours)}: a data set is read only, in a storage of its own."
        )
    return TensorDictReplayBuffer(
        storage=_storage(folder), writer=ImmutableDatasetWriter(), collate_fn=as_they_are, **options
    )


def trajectories(folder: Path | str) -> Tensor:
    """Return numbers of the episodes that the steps of :func:`replay_buffer` are of, ``[frames]``.

    For ``SliceSampler(slice_len=20, trajectories=trajectories(folder), cache_values=True)``: with the name of a key
    instead, it reads the whole data set for every batch.
    """
    return _storage(folder).leaf(("collector", "traj_ids"))


def _storage(folder: Path | str) -> ShardStorage:
    return ShardStorage(load_shards(folder), environments=_read_manifest(folder)[0])


def load_shards(folder: Path | str) -> list[Shard]:
    """Open the shards of a data set, memory-mapped; see :func:`load`."""
    folder = expanded(folder)
    _, slots, named = _read_manifest(folder)
    shards = [(folder / name, frames) for name, frames in named]
    missing = [shard.name for shard, _ in shards if not shard.is_dir()]
    if missing or not shards:
        raise IzooError(f"{folder} lacks {', '.join(missing) or 'any shard'}; copy it whole, or collect again.")
    with reading(folder):
        leaves = [check_files(shard) for shard, _ in shards]
        if any(found != leaves[0] for found in leaves):
            raise ValueError("its shards hold different things")
        # Pickled values would run what a foreign data set holds.
        opened = [Shard(TensorDict.load_memmap(shard, allow_pickle=False), slots) for shard, _ in shards]
        if any(len(shard) != frames for shard, (_, frames) in zip(opened, shards, strict=True)):
            raise ValueError(f"its shards have {[len(shard) for shard in opened]} frames, not as {MANIFEST} says")
    return opened


def _read_manifest(folder: Path | str) -> tuple[int, int, list[tuple[str, int]]]:
    """Return how many environments stepped together, their agent slots, and name and frames of every shard."""
    path = expanded(folder) / MANIFEST
    if not path.is_file():
        raise IzooError(f"{path.parent} has no {MANIFEST}; give a folder that python -m izoo.collect has written.")
    with reading(path):
        manifest = json.loads(path.read_text())
        if manifest["format"] != FORMAT:
            raise ValueError(f"it is of format {manifest['format']!r}, not {FORMAT}")
        shards = [(shard["name"], int(shard["frames"])) for shard in manifest["shards"]]
        for name, _ in shards:
            if name in ("", "..") or name != Path(name).name:
                raise ValueError(f"{name!r} is not the name of a shard")
        slots = check_whole("slots", manifest["slots"], 1, MAX_AGENTS)
        return check_whole("environments", manifest["environments"], 1, MAX_ENVS), slots, shards
