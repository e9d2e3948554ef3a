"""Collected data sets, read whole or as they are sampled."""

from __future__ import annotations

import json
from pathlib import Path

from tensordict import TensorDict

from izoo.conf.train_options import MAX_ENVS
from izoo.envs.config import MAX_AGENTS
from izoo.errors import IzooError, check_whole
from izoo.files import expanded, reading
from izoo.training.shard_writer import FORMAT, MANIFEST
from izoo.training.shards import Shard, ShardStorage, check_files


def storage(folder: Path | str) -> ShardStorage:
    """Return the steps of a data set, those of one environment after those of another; see :func:`load_shards`."""
    return ShardStorage(load_shards(folder), environments=_read_manifest(folder)[0])


def load_shards(folder: Path | str) -> list[Shard]:
    """Open the shards of a data set, memory-mapped.

    Raises:
        IzooError: the folder is not a finished data set of izoo, or a shard is missing.
    """
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
