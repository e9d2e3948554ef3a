"""Collected steps on disk: a file per leaf, which only grows, and a manifest that says how much of it counts."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import MemoryMappedTensor, TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data.replay_buffers.storages import Storage

from izoo import __version__
from izoo.conf.train_options import MAX_ENVS, CollectConfig
from izoo.envs.config import MAX_AGENTS
from izoo.envs.mdp.frame import observation_names
from izoo.errors import IzooError, check_whole
from izoo.files import expanded, reading, write_json
from izoo.options import to_mapping

FORMAT, MANIFEST = "izoo-steps-4", "manifest.json"
AGENTS = {"agents": "agents", "next": ("next", "agents")}
"""Groups of agents, by the name under which they are stored."""


def as_they_are(rows: TensorDictBase) -> TensorDictBase:
    """Collate rows that a :class:`StoredSteps` has put together already."""
    return rows


def pack(steps: TensorDictBase) -> TensorDict:
    """Return steps ``[n]`` as they are stored: without empty slots.

    Returns:
        ``steps`` ``[n]``: everything but the agents, and ``count``, how many rows of agents each has; ``rows`` ``[R]``:
        the agents of all steps, one after the other, in slots that hold a vehicle before or after the step, with
        their ``slot``.
    """
    held = steps["agents", "mask"] | steps["next", "agents", "mask"]
    rows = {
        name: steps[key].apply(lambda leaf: leaf[held], batch_size=[int(held.sum())]) for name, key in AGENTS.items()
    }
    rows["slot"] = held.nonzero()[:, 1].short()
    rest = steps.exclude(*AGENTS.values()).set("count", held.sum(-1))
    return TensorDict({"steps": rest, "rows": TensorDict(rows, [len(rows["slot"])])}, [])


class StepsWriter:
    """Appends steps to a data set; what its manifest counts is complete, whenever writing ends.

    Args:
        config: options of the collection.
        out: an empty folder.

    Attributes:
        frames: steps that are there.
    """

    def __init__(self, config: CollectConfig, out: Path) -> None:
        self.config, self.out = config, out
        self.frames = self._rows = 0

    def write(self, steps: TensorDictBase) -> None:
        """Append ``steps [n]``, as far as they are still wanted.

        Raises:
            OSError: the disk is full.
        """
        packed, leaves = pack(steps[: self.config.frames - self.frames]), {}
        for key, leaf in packed.items(True, True):
            name = ".".join(key)
            with _file(self.out, name).open("ab") as file:
                file.write(leaf.contiguous().numpy().tobytes())
            leaves[name] = str(leaf.dtype), list(leaf.shape[1:])
        frames, rows = self.frames + len(packed["steps"]), self._rows + len(packed["rows"])
        manifest = {
            "format": FORMAT,
            "izoo": __version__,
            "frames": frames,
            "rows": rows,
            "leaves": leaves,
            "simulator": self.config.simulator,
            "environments": self.config.environments,
            "slots": self.config.env.num_agents,
            "observation_names": list(observation_names(self.config.env)),
            "options": to_mapping(self.config),
        }
        write_json(self.out / MANIFEST, manifest, durable=False)
        self.frames, self._rows = frames, rows


class StoredSteps(Storage):
    """Stored steps for TorchRL's replay buffers: those of one environment after those of another; read only.

    A replay buffer with ``collate_fn=as_they_are`` samples from it: an index copies the rows that it names, and no
    others, and fills the empty slots with zeros (``number``: -1).

    Args:
        packed: what :func:`pack` returned of steps, environment after environment within a time step.
        slots: of an environment.
        environments: how many stepped together.
    """

    def __init__(self, packed: TensorDictBase, slots: int, environments: int = 1) -> None:
        self.steps, self.rows, self.slots, self.environments = packed["steps"], packed["rows"], slots, environments
        super().__init__(len(self.steps))
        # Where each step is stored: in the order of time, environment after environment.
        self._order = (torch.arange(len(self.steps)) % environments).argsort(stable=True)
        count = self.steps["count"]
        self._ends = count.cumsum(0)
        if bool((count < 0).any()) or int(count.sum()) != len(self.rows):
            raise ValueError(f"its steps have {int(count.sum())} rows of agents, and {len(self.rows)} are there")

    def __len__(self) -> int:
        return self.max_size

    def get(self, index: int | slice | Sequence[int] | Tensor) -> TensorDictBase:
        """Return the steps that ``index`` names: one without batch dimension, or ``[n]`` in the order given.

        Raises:
            IndexError: a step is beyond the last.
        """
        wanted = self._order[index]
        rows = self.collected(wanted.reshape(-1))
        return rows[0] if wanted.ndim == 0 else rows.reshape(wanted.shape)

    def collected(self, index: Tensor | slice = slice(None)) -> TensorDictBase:
        """Return steps ``[n]`` in the order of their collection: environment after environment within a time step."""
        steps = self.steps[index].to_tensordict()
        count, ends = steps.pop("count"), self._ends[index]
        place = torch.arange(len(steps)).repeat_interleave(count)
        rows = self.rows[torch.arange(len(place)) + (ends - count.cumsum(0)).repeat_interleave(count)]
        slot = rows["slot"].long()

        def padded(name: str, leaf: Tensor) -> Tensor:
            full = leaf.new_full((len(steps), self.slots, *leaf.shape[1:]), -1 if name == "number" else 0)
            full[place, slot] = leaf
            return full

        for name, key in AGENTS.items():
            steps.set(key, rows[name].named_apply(padded, batch_size=[len(steps), self.slots]))
        return steps

    def leaf(self, key: NestedKey) -> Tensor:
        """Return one leaf, not of agents, of all steps ``[frames, ...]``; the others are not read."""
        return self.steps.get(key)[self._order]

    def set(self, *_: Any, **__: Any) -> None:
        """Refuse: data sets are read only."""
        raise IzooError("a collected data set is read only; copy what you need into a storage of your own.")

    def state_dict(self) -> dict[str, Any]:
        """Return nothing: the data are in their files."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Accept what :meth:`state_dict` returned."""


def open_steps(folder: Path | str) -> StoredSteps:
    """Open a data set, memory-mapped.

    Raises:
        IzooError: the folder is not a data set of izoo, or not whole.
    """
    folder = expanded(folder)
    path = folder / MANIFEST
    if not path.is_file():
        raise IzooError(f"{folder} has no {MANIFEST}; give a folder that python -m izoo.collect has written.")
    with reading(path):
        manifest = json.loads(path.read_text())
        if manifest["format"] != FORMAT:
            raise ValueError(f"it is of format {manifest['format']!r}, not {FORMAT}")
        slots = check_whole("slots", manifest["slots"], 1, MAX_AGENTS)
        environments = check_whole("environments", manifest["environments"], 1, MAX_ENVS)
        sizes = {"steps": int(manifest["frames"]), "rows": int(manifest["rows"])}
        packed = TensorDict({name: TensorDict({}, [size]) for name, size in sizes.items()}, [])
        for name, (dtype, shape) in manifest["leaves"].items():
            key = tuple(name.split("."))
            packed.set(key, _mapped(_file(folder, name), dtype, torch.Size((sizes[key[0]], *shape))))
        return StoredSteps(packed, slots, environments)


def _file(folder: Path, name: str) -> Path:
    if name != Path(name).name:
        raise ValueError(f"{name!r} is not a file name")
    return folder / f"{name}.bin"


def _mapped(path: Path, dtype: str, shape: torch.Size) -> Tensor:
    """Map the beginning of a file, which is all there: torch itself would extend one that is too short, with zeros."""
    kind = getattr(torch, dtype.removeprefix("torch."))
    size, there = math.prod(shape) * kind.itemsize, path.stat().st_size if path.is_file() else 0
    if there < size:
        raise ValueError(f"{path} has {there:,} bytes, and should have {size:,}")
    return MemoryMappedTensor.from_filename(path, kind, shape) if size else torch.empty(shape, dtype=kind)
