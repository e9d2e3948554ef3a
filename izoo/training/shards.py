"""The shards of a data set as one storage for TorchRL's replay buffers; nothing is read before it is drawn."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data.replay_buffers.storages import Storage

from izoo.errors import IzooError


def as_they_are(rows: TensorDictBase) -> TensorDictBase:
    """Collate rows that a :class:`ShardStorage` has put together already."""
    return rows


def check_files(folder: Path) -> dict[str, tuple[str, list[int]]]:
    """Return type and shape, without the first dimension, of every leaf of a memory-mapped TensorDict.

    Its files are all there then, and whole: torch itself extends one that is too short, with zeros, when it maps it.

    Raises:
        ValueError: a file is missing or of another size, or its name leads out of the folder.
    """
    leaves: dict[str, tuple[str, list[int]]] = {}
    for name, entry in json.loads((folder / "meta.json").read_text()).items():
        if not isinstance(entry, dict):
            continue
        if name == ".." or name != Path(name).name:
            raise ValueError(f"{name!r} is not a file name")
        if "dtype" not in entry:
            leaves |= {f"{name}/{leaf}": form for leaf, form in check_files(folder / name).items()}
            continue
        path = folder / f"{name}.memmap"
        size = math.prod(entry["shape"]) * getattr(torch, entry["dtype"].removeprefix("torch.")).itemsize
        there = path.stat().st_size if path.is_file() else 0
        if there != size:
            raise ValueError(f"{path} has {there:,} bytes, and should have {size:,}")
        leaves[name] = (entry["dtype"], entry["shape"][1:])
    return leaves


def pack(steps: TensorDictBase) -> TensorDict:
    """Return steps ``[n]`` as they are stored: without empty slots.

    Returns:
        ``steps`` ``[n]``: everything but the agents, and ``count``, how many rows of agents each has; ``rows`` ``[R]``:
        the agents of all steps, one after the other, in slots that hold a vehicle before or after the step, with
        their ``slot``.
    """
    held = steps["agents", "mask"] | steps["next", "agents", "mask"]
    rows = {
        name: steps[key].apply(lambda leaf: leaf[held], batch_size=[int(held.sum())])
        for name, key in (("agents", "agents"), ("next", ("next", "agents")))
    }
    rows["slot"] = held.nonzero()[:, 1].short()
    rest = steps.exclude("agents", ("next", "agents")).set("count", held.sum(-1))
    return TensorDict({"steps": rest, "rows": TensorDict(rows, [len(rows["slot"])])}, [])


class Shard:
    """Memory-mapped steps; an index reads what it names and fills the empty slots with zeros (``number``: -1).

    Args:
        packed: what :func:`pack` returned.
        slots: of an environment.
    """

    def __init__(self, packed: TensorDictBase, slots: int) -> None:
        self.steps, self.rows, self.slots = packed["steps"], packed["rows"], slots
        count = self.steps["count"]
        self._ends = count.cumsum(0)
        if bool((count < 0).any()) or int(count.sum()) != len(self.rows):
            raise ValueError(f"its steps have {int(count.sum())} rows of agents, and {len(self.rows)} are there")

    def __len__(self) -> int:
        return len(self.steps)

    def __getitem__(self, index: Tensor | slice) -> TensorDictBase:
        """Return the steps ``[n]`` that an index of one dimension names."""
        steps = self.steps[index].to_tensordict()
        count, ends = steps.pop("count"), self._ends[index]
        place = torch.arange(len(steps)).repeat_interleave(count)
        shift = (ends - count.cumsum(0)).repeat_interleave(count)
        rows = self.rows[torch.arange(len(place)) + shift]
        slot = rows["slot"].long()

        def padded(name: str, leaf: Tensor) -> Tensor:
            full = leaf.new_full((len(steps), self.slots, *leaf.shape[1:]), -1 if name == "number" else 0)
            full[place, slot] = leaf
            return full

        for name, key in (("agents", "agents"), ("next", ("next", "agents"))):
            steps.set(key, rows[name].named_apply(padded, batch_size=[len(steps), self.slots]))
        return steps


class ShardStorage(Storage):
    """Memory-mapped shards as one sequence of steps, those of one environment after those of another; read only.

    A replay buffer with ``collate_fn=as_they_are`` samples from it: an index copies the rows that it names, and no
    others.

    Args:
        shards: with the same leaves, environment after environment within a time step.
        environments: how many stepped together.
    """

    def __init__(self, shards: Sequence[Shard], environments: int = 1) -> None:
        super().__init__(sum(len(shard) for shard in shards))
        self.shards, self.environments = list(shards), environments
        self._starts = torch.tensor([0, *itertools.accumulate(len(shard) for shard in shards)])

    def __len__(self) -> int:
        return self.max_size

    def get(self, index: int | slice | Sequence[int] | Tensor) -> TensorDictBase:
        """Return the steps that ``index`` names: one without batch dimension, or ``[n]`` in the order given.

        Raises:
            IndexError: a step is beyond the last.
        """
        if isinstance(index, tuple) and len(index) == 1:
            index = index[0]
        if isinstance(index, slice):
            index = torch.arange(*index.indices(len(self)))
        wanted = torch.as_tensor(index)
        if wanted.dtype == torch.bool:
            wanted = wanted.nonzero().view(-1)
        flat = torch.where(wanted < 0, wanted + len(self), wanted).reshape(-1)
        if len(flat) > 0 and not (int(flat.min()) >= 0 and int(flat.max()) < len(self)):
            raise IndexError(f"an index is out of range: the data set has {len(self)} steps")
        if len(flat) == 0:
            return self.shards[0][flat]
        flat = self._stored(flat)
        owner = torch.searchsorted(self._starts, flat, right=True) - 1
        parts, places = [], []
        for shard in owner.unique().tolist():
            place = (owner == shard).nonzero().view(-1)
            parts.append(self.shards[shard][flat[place] - self._starts[shard]])
            places.append(place)
        rows = parts[0] if len(parts) == 1 else torch.cat(parts)[torch.cat(places).argsort()]
        return rows[0] if wanted.ndim == 0 else rows.reshape(wanted.shape)

    def leaf(self, key: NestedKey) -> Tensor:
        """Return one leaf, not of agents, of all steps ``[frames, ...]``; the others are not read."""
        return torch.cat([shard.steps.get(key) for shard in self.shards])[self._stored(torch.arange(len(self)))]

    def _stored(self, steps: Tensor) -> Tensor:
        """Return where steps ``[n]`` of this sequence are stored; the first environments may have a step more."""
        times, more = divmod(len(self), self.environments)
        long = more * (times + 1)
        rest = (steps - long).clamp_min(0)
        in_long = steps < long
        environment = torch.where(in_long, steps // (times + 1), more + rest // max(times, 1))
        time = torch.where(in_long, steps % (times + 1), rest % max(times, 1))
        return time * self.environments + environment

    def contains(self, item: int) -> bool:
        """Whether there is a step of this number."""
        return -len(self) <= int(item) < len(self)

    def set(self, cursor: Any, data: Any, *, set_cursor: bool = True) -> None:
        """Refuse: data sets are read only."""
        raise IzooError("a collected data set is read only; copy what you need into a storage of your own.")

    def state_dict(self) -> dict[str, Any]:
        """Return nothing: the data are in their files."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Accept what :meth:`state_dict` returned."""

    def _empty(self) -> None:
        raise IzooError("a collected data set is read only; it cannot be emptied.")
