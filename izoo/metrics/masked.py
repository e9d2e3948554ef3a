"""Reductions over the entries that a mask calls valid: the only place where means over slots are taken.

Every function selects with ``torch.where`` and never multiplies by the mask, so that NaN or noise in an empty slot
changes nothing (NaN times zero is NaN). ``mask`` is bool and broadcasts against ``x``. A reduction over nothing
returns 0.
"""

from __future__ import annotations

import torch
from torch import Tensor

Dim = int | tuple[int, ...]


def masked_sum(x: Tensor, mask: Tensor, dim: Dim = -1, keepdim: bool = False) -> Tensor:
    """Sum of the valid entries along ``dim``: ``[*B, N] -> [*B]``; 0 over nothing."""
    return torch.where(mask, x, torch.zeros_like(x)).sum(dim, keepdim=keepdim)


def masked_mean(x: Tensor, mask: Tensor, dim: Dim = -1, keepdim: bool = False) -> Tensor:
    """Mean of the valid entries along ``dim``: ``[*B, N] -> [*B]``; 0 over nothing."""
    count = mask.expand_as(x).sum(dim, keepdim=keepdim).to(x.dtype)
    return masked_sum(x, mask, dim, keepdim) / count.clamp_min(1)
