"""Steps written as memory-mapped shards, with a manifest of the finished ones."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase

from izoo import __version__
from izoo.conf.mapping import to_mapping
from izoo.conf.train_options import CollectConfig
from izoo.envs.mdp.frame import observation_names
from izoo.files import NO_ROOM, write_json

MANIFEST = "manifest.json"
FORMAT = "izoo-steps-2"


class ShardWriter:
    """Writes steps into memory-mapped shards of a given length, and the manifest after each finished one.

    Args:
        config: options of the collection.
        out: an empty folder.
    """

    def __init__(self, config: CollectConfig, out: Path) -> None:
        self.config, self.out = config, out
        self.frames = 0
        self._shards: list[dict[str, Any]] = []
        self._open: TensorDictBase | None = None
        self._filled = 0

    def write(self, steps: TensorDictBase) -> None:
        """Append ``steps [n]``, as far as they are still wanted."""
        steps = steps[: self.config.frames - self.frames]
        while len(steps) > 0:
            if self._open is None:
                length = min(self.config.shard_frames, self.config.frames - self.frames)
                self._open = steps[0].expand(length).memmap_like(str(self._partial))
                reserve(self._partial)
                self._filled = 0
            part = steps[: len(self._open) - self._filled]
            self._open[self._filled : self._filled + len(part)] = part
            self._filled += len(part)
            self.frames += len(part)
            steps = steps[len(part) :]
            if self._filled == len(self._open):
                self.finish_shard()

    def finish_shard(self) -> None:
        """Put the shard that is being filled in its place, and name it in the manifest."""
        if self._open is None:
            return
        name = f"shard-{len(self._shards):05d}"
        self._open = None
        self._partial.rename(self.out / name)
        self._shards.append({"name": name, "frames": self._filled})
        self._write_manifest()

    def discard(self) -> None:
        """Remove what was not finished."""
        shutil.rmtree(self._partial, ignore_errors=True)

    @property
    def _partial(self) -> Path:
        return self.out / ".shard.partial"

    def _write_manifest(self) -> None:
        manifest = {
            "format": FORMAT,
            "izoo": __version__,
            "frames": sum(shard["frames"] for shard in self._shards),
            "simulator": self.config.simulator,
            "environments": self.config.environments,
            "observation_names": list(observation_names(self.config.env)),
            "shards": self._shards,
            "options": to_mapping(self.config),
        }
        write_json(self.out / MANIFEST, manifest)


def reserve(folder: Path) -> None:
    """Take the room that the files of a memory-mapped TensorDict need: a full disk would else end the process.

    Raises:
        OSError: there is not enough.
    """
    if not hasattr(os, "posix_fallocate"):
        return
    for path in folder.rglob("*.memmap"):
        size = path.stat().st_size
        if size:
            with path.open("r+b") as file:
                try:
                    os.posix_fallocate(file.fileno(), 0, size)
                except OSError as error:
                    if error.errno in NO_ROOM:
                        raise  # not every file system can do this, and then it is left to chance
