"""Collected data sets, opened without reading them into memory."""

from __future__ import annotations

import json
from pathlib import Path

from tensordict import TensorDict, TensorDictBase

from izoo.conf.train_options import MAX_ENVS
from izoo.errors import IzooError, check_whole
from izoo.files import expanded, reading
from izoo.training.shard_writer import FORMAT, MANIFEST
from izoo.training.shards import ShardStorage, check_files


def storage(folder: Path | str) -> ShardStorage:
    """Return the steps of a data set, those of one environment after those of another; see :func:`load_shards`."""
    return ShardStorage(load_shards(folder), environments=_read_manifest(folder)[0])


def load_shards(folder: Path | str) -> list[TensorDictBase]:
    """Open the shards of a data set, each ``[frames of the shard]``, memory-mapped.

    Raises:
        IzooError: the folder is not a finished data set of izoo, or a shard is missing.
    """
    folder = expanded(folder)
    shards = [(folder / name, frames) for name, frames in _read_manifest(folder)[1]]
    missing = [shard.name for shard, _ in shards if not shard.is_dir()]
    if missing or not shards:
        raise IzooError(f"{folder} lacks {', '.join(missing) or 'any shard'}; copy it whole, or collect again.")
    with reading(folder):
        leaves = [check_files(shard) for shard, _ in shards]
        if any(found != leaves[0] for found in leaves):
            raise ValueError("its shards hold different things")
        # Pickled values would run what a foreign data set holds.
        opened = [(TensorDict.load_memmap(shard, allow_pickle=False), frames) for shard, frames in shards]
        if any(not 1 <= frames <= len(steps) for steps, frames in opened):
            raise ValueError(f"its shards have {[len(steps) for steps, _ in opened]} frames, not as {MANIFEST} says")
    # A collection that Ctrl-C ended leaves room at the end of its last shard.
    return [steps if len(steps) == frames else steps[:frames] for steps, frames in opened]


def _read_manifest(folder: Path | str) -> tuple[int, list[tuple[str, int]]]:
    """Return how many environments stepped together, and name and frames of every shard."""
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
        return check_whole("environments", manifest["environments"], 1, MAX_ENVS), shards
