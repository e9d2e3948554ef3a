"""Losses of batches that hold no agents, which light traffic produces."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule


def has_no_agents(batch: TensorDictBase, mask: Tensor | None) -> bool:
    """Whether no agent is in a batch ``[*B]``: light traffic makes such ones."""
    return batch.numel() == 0 if mask is None else not bool(mask.any())


def no_losses(loss: LossModule) -> TensorDict:
    """Return losses of 0, whose gradients are 0, and statistics of 0: TorchRL's averages over no rows are NaN."""
    zero = 0.0 * torch.stack([weights.sum() for weights in loss.parameters()]).sum()
    keys = loss.out_keys
    return TensorDict({key: zero if key.startswith("loss_") else zero.detach() for key in keys}, batch_size=[])
