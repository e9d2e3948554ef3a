"""Valid agent-steps of masked batches as flat rows, and networks on whole frames applied to such rows."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

from izoo.algos.networks.set_networks import COLUMN, FRAME, Sets, places
from izoo.errors import IzooError


class OnRows(TensorDictModuleBase):
    """A module that reads whole frames and their mask, applied to flat rows with the frames that they belong to.

    Args:
        module: reads leaves ``[K, W, ...]`` and the mask ``[K, W]``; writes ``[K, W, ...]``, or ``[K, 1]``, one value
            for all agents of a frame.
        mask: key of the mask.
    """

    def __init__(self, module: TensorDictModuleBase, mask: NestedKey) -> None:
        super().__init__()
        self.module, self.mask = module, mask
        self.sources = [key for key in module.in_keys if key != mask]
        self.in_keys, self.out_keys = [*self.sources, FRAME, COLUMN], list(module.out_keys)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the module's outputs as rows."""
        frame, column = tensordict.get(FRAME), tensordict.get(COLUMN)
        sets = Sets.frames(frame, column)
        frames = TensorDict(batch_size=[sets.shape[0]], device=frame.device)
        frames.set(self.mask, sets.pack(torch.ones_like(frame, dtype=torch.bool)))
        for key in self.sources:
            frames.set(key, sets.pack(tensordict.get(key)))
        self.module(frames)
        for key in self.out_keys:
            found = frames.get(key)
            tensordict.set(key, found[frame] if found.ndim == 2 else sets.unpack(found))
        return tensordict


class InFrames(TensorDictModuleBase):
    """A module that looks at all agents of a frame, on rows; each row may bring its whole frame along.

    Rows do where not all agents of a frame are learned from (:func:`rows_of`); then a row's frame is :data:`AROUND`.

    Args:
        module: reads rows of whole frames, with their :data:`~izoo.algos.networks.set_networks.FRAME`.
    """

    def __init__(self, module: TensorDictModuleBase) -> None:
        super().__init__()
        self.module, self.in_keys, self.out_keys = module, list(module.in_keys), list(module.out_keys)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the module's outputs as rows."""
        around = tensordict.get(AROUND, None)
        if around is None:
            return self.module(tensordict)
        there, own = around.get("there"), around.get("own")
        rows = TensorDict(batch_size=[int(there.sum())], device=there.device)
        for key in self.in_keys:
            leaf = around.get(key, None)
            if leaf is not None:
                rows.set(key, leaf[there])
        frame, column = places(there)
        self.module(rows.set(FRAME, frame).set(COLUMN, column))
        for key in self.out_keys:
            tensordict.set(key, rows.get(key)[own[there]])
        return tensordict


def on_rows(module: Any, mask: NestedKey) -> Any:
    """Return what applies ``module`` to rows: itself, unless it or a part of it looks at whole frames."""
    if isinstance(module, InFrames):
        return module
    if isinstance(module, ProbabilisticTensorDictSequential):
        parts = list(module.module)
        if any(mask in part.in_keys or FRAME in part.in_keys for part in parts):
            return ProbabilisticTensorDictSequential(*(on_rows(part, mask) for part in parts))
        return module
    if mask in module.in_keys:
        module = OnRows(module, mask)
    return InFrames(module) if is_set_module(module) else module


def is_set_module(module: TensorDictModuleBase) -> bool:
    """Whether a module on rows looks at all agents of a frame."""
    return FRAME in module.in_keys


AROUND = "around"
"""Key of the frames ``[n, A]`` that rows ``[n]`` bring along: ``there`` and ``own``, and the leaves."""


def rows_around(batch: TensorDictBase, there: Tensor, wanted: Tensor, keys: Iterable[NestedKey]) -> TensorDict:
    """Return the frames ``[n, A]`` of the ``n`` agents that are ``wanted``, one for each: :data:`AROUND` of their rows.

    Args:
        batch: ``[*B]``.
        there, wanted: ``[*B, A]``: all agents, and some of them.
        keys: of the leaves that networks read.
    """
    *frame, slot = wanted.nonzero(as_tuple=True)
    around = TensorDict({"there": there[tuple(frame)]}, [len(slot), there.shape[-1]], device=there.device)
    around.set("own", torch.nn.functional.one_hot(slot, there.shape[-1]).bool())
    for key in dict.fromkeys(keys):
        leaf = batch.get(key, None)
        if leaf is not None and key not in (FRAME, COLUMN):
            around.set(key, leaf[tuple(frame)])
    return around


def rows_of(batch: TensorDictBase, mask: Tensor, keys: Iterable[NestedKey], origin: Tensor | None = None) -> TensorDict:
    """Return the valid entries of leaves ``[*B, A, ...]`` as rows ``[n]``.

    Keys that the batch does not hold are left out; where they are asked for, each row's frame and column are made.

    Args:
        batch: ``[*B]``.
        mask: ``[*B, A]`` of the valid entries.
        keys: of the leaves.
        origin: ``[B, d]`` where frames ``[B]`` came from, for messages.

    Raises:
        IzooError: a valid entry is not finite; the message says which.
    """
    held, wanted = mask.nonzero(as_tuple=True), dict.fromkeys(keys)
    rows = TensorDict(batch_size=[len(held[0])], device=mask.device)
    for key in wanted:
        leaf = batch.get(key, None)
        if leaf is not None and key not in (FRAME, COLUMN):
            rows.set(key, leaf[held])
    check_finite(rows, mask, origin)
    if FRAME in wanted:
        frame, column = places(mask)
        rows.set(FRAME, frame).set(COLUMN, column)
    return rows


def check_finite(rows: TensorDictBase, mask: Tensor | None = None, origin: Tensor | None = None) -> None:
    """Raise :class:`IzooError` for the first row that is not finite; ``mask`` tells where it came from."""
    for key in rows.keys(True, True):
        leaf = rows.get(key)
        if not leaf.is_floating_point() or bool(leaf.sum().isfinite()) or bool(leaf.isfinite().all()):
            continue  # the sum of large numbers may be infinite, and takes a tenth of the time of a look at each
        bad = (~torch.isfinite(leaf)).reshape(len(leaf), -1).any(1).nonzero()[:, 0]
        what = "NaN" if leaf[bad[0]].isnan().any() else "infinite"
        place = f"row {int(bad[0])}"
        if mask is not None:
            *frame, slot = mask.nonzero()[bad[0]].tolist()
            frame = frame if origin is None else origin[frame[0]].tolist()
            place = f"entry {[*frame, slot]} of the mask, the last of which is the slot"
        raise IzooError(
            f"{key!r} is {what} in {len(bad)} valid agent-steps, first in {place}; set the mask to false where no "
            "agent is, and look for what computes this value."
        )


def path_of(key: NestedKey) -> tuple[str, ...]:
    """Return a key as a tuple."""
    return (key,) if isinstance(key, str) else tuple(key)


def has_no_agents(batch: TensorDictBase, mask: Tensor | None) -> bool:
    """Whether no agent is in a batch ``[*B]``: light traffic makes such ones."""
    return batch.numel() == 0 if mask is None else not bool(mask.any())


def no_losses(loss: LossModule) -> TensorDict:
    """Return losses of 0, whose gradients are 0, and statistics of 0: TorchRL's averages over no rows are NaN."""
    zero = 0.0 * torch.stack([weights.sum() for weights in loss.parameters()]).sum()
    keys = loss.out_keys
    return TensorDict({key: zero if key.startswith("loss_") else zero.detach() for key in keys}, batch_size=[])
