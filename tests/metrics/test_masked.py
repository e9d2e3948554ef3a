"""Masked reductions against their plain forms on the valid entries, and against noise in the others."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from izoo.metrics.masked import masked_mean, masked_sum

PLAIN: list[tuple[Callable[..., Tensor], Callable[[Tensor], Tensor]]] = [
    (masked_sum, torch.sum),
    (masked_mean, torch.mean),
]


@pytest.fixture
def batch() -> tuple[Tensor, Tensor]:
    """``x`` [4, 7], ``mask`` [4, 7]; the last row has nothing valid."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(4, 7, generator=generator)
    mask = torch.rand(4, 7, generator=generator) < 0.6
    mask[:3, :2] = True
    mask[3] = False
    return x, mask


@pytest.mark.parametrize(("masked", "plain"), PLAIN)
def test_equals_the_plain_form_on_valid_entries(masked, plain, batch) -> None:
    x, mask = batch
    result = masked(x, mask)
    for row in range(3):
        assert torch.allclose(result[row], plain(x[row][mask[row]]))
    assert result[3] == 0.0


@pytest.mark.parametrize(("masked", "plain"), PLAIN)
@pytest.mark.parametrize("noise", [torch.nan, torch.inf, -1e30])
def test_noise_in_empty_slots_changes_nothing(masked, plain, noise, batch) -> None:
    x, mask = batch
    dirty = torch.where(mask, x, torch.full_like(x, noise))
    assert torch.equal(masked(dirty, mask), masked(x, mask))
    assert torch.equal(masked(dirty, mask, (0, 1)), masked(x, mask, (0, 1)))


@pytest.mark.parametrize(("masked", "plain"), PLAIN)
def test_gradients_stay_finite_and_miss_the_empty_slots(masked, plain, batch) -> None:
    x, mask = batch
    leaf = torch.where(mask, x, torch.full_like(x, torch.nan)).requires_grad_()
    masked(leaf, mask).sum().backward()
    assert leaf.grad is not None
    assert torch.isfinite(leaf.grad).all()
    assert (leaf.grad[~mask] == 0).all()


def test_mask_broadcasts_over_trailing_features() -> None:
    x = torch.arange(12.0).reshape(2, 3, 2)
    mask = torch.tensor([[True, False, True], [False, False, True]]).unsqueeze(-1)
    assert torch.equal(masked_mean(x, mask, 1), torch.tensor([[2.0, 3.0], [10.0, 11.0]]))
    assert masked_sum(x, mask, 1, keepdim=True).shape == (2, 1, 2)
