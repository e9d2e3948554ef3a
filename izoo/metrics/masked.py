"""Reductions over the entries that a mask calls valid: the only place where means over slots are taken.

Every function selects with ``torch.where`` and never multiplies by the mask, so that NaN or noise in an empty slot
changes nothing (NaN times zero is NaN). ``mask`` is bool and broadcasts against ``x``. A reduction over nothing
returns 0, or ``empty`` for the extremes; :func:`any_valid` says where that happened.
"""

from __future__ import annotations

import torch
from torch import Tensor

Dim = int | tuple[int, ...]


def any_valid(mask: Tensor, dim: Dim = -1, keepdim: bool = False) -> Tensor:
    """Whether anything is valid along ``dim``: ``[*B, N] bool -> [*B] bool``."""
    return mask.any(dim, keepdim=keepdim)


def masked_count(x: Tensor, mask: Tensor, dim: Dim = -1, keepdim: bool = False) -> Tensor:
    """Number of valid entries of ``x`` along ``dim``, in ``x``'s dtype: ``[*B, N] -> [*B]``."""
    return mask.expand_as(x).sum(dim, keepdim=keepdim).to(x.dtype)


def masked_sum(x: Tensor, mask: Tensor, dim: Dim = -1, keepdim: bool = False) -> Tensor:
    """Sum of the valid entries along ``dim``: ``[*B, N] -> [*B]``; 0 over nothing."""
    return torch.where(mask, x, torch.zeros_like(x)).sum(dim, keepdim=keepdim)


def masked_mean(x: Tensor, mask: Tensor, dim: Dim = -1, keepdim: bool = False) -> Tensor:
    """Mean of the valid entries along ``dim``: ``[*B, N] -> [*B]``; 0 over nothing."""
    count = masked_count(x, mask, dim, keepdim)
    return masked_sum(x, mask, dim, keepdim) / count.clamp_min(1)


def masked_std(x: Tensor, mask: Tensor, dim: Dim = -1, keepdim: bool = False, correction: int = 1) -> Tensor:
    """Standard deviation of the valid entries along ``dim``: ``[*B, N] -> [*B]``.

    Args:
        correction: subtracted from the count in the denominator, as in :func:`torch.std`. Where no more than
            ``correction`` entries are valid the result is 0.
    """
    x = torch.where(mask, x, torch.zeros_like(x))
    centred = x - masked_mean(x, mask, dim, keepdim=True)
    count = masked_count(x, mask, dim, keepdim)
    variance = masked_sum(centred.square(), mask, dim, keepdim) / (count - correction).clamp_min(1)
    positive = variance > 0
    # The inner `where` keeps the gradient of sqrt finite at zero.
    root = torch.where(positive, variance, torch.ones_like(variance)).sqrt()
    return torch.where(positive & (count > correction), root, torch.zeros_like(root))


def masked_min(x: Tensor, mask: Tensor, dim: Dim = -1, keepdim: bool = False, empty: float = 0.0) -> Tensor:
    """Smallest valid entry along ``dim``: ``[*B, N] -> [*B]``; ``empty`` over nothing."""
    low = torch.where(mask, x, torch.full_like(x, torch.inf)).amin(dim, keepdim=keepdim)
    return torch.where(mask.expand_as(x).any(dim, keepdim=keepdim), low, torch.full_like(low, empty))


def masked_max(x: Tensor, mask: Tensor, dim: Dim = -1, keepdim: bool = False, empty: float = 0.0) -> Tensor:
    """Largest valid entry along ``dim``: ``[*B, N] -> [*B]``; ``empty`` over nothing."""
    high = torch.where(mask, x, torch.full_like(x, -torch.inf)).amax(dim, keepdim=keepdim)
    return torch.where(mask.expand_as(x).any(dim, keepdim=keepdim), high, torch.full_like(high, empty))
