"""A distribution over advice, with a point mass on doing nothing.

Advice of 0 leaves a vehicle as it is. What a network says is censored: every value in a band around its origin stands
for the same event, "nothing", which has a probability of its own and no density. So its log-probability is that of the
whole band, and the gradient of a policy does not depend on which of the equivalent values happened to be drawn
(clipped-action policy gradient, arXiv 1802.07564).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.distributions import Distribution, Normal, constraints
from torchrl.modules import TanhNormal

HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)
MOST_EXCESS = 4.0
"""Advice is cut off here: a tanh of 0.9993, which single precision can still undo."""


class RestingNormal(Distribution):
    """Advice ``bound * tanh(x - dead)`` of a normal ``x`` above the band ``[-dead, dead]``, and 0 within it.

    Below the band, advice is ``bound * tanh(x + dead)`` where ``guided``, and 0 elsewhere: the band has no lower end.

    Args:
        loc, scale: ``[*M, 1]`` of ``x``.
        bound: advice lies between plus and minus this.
        dead: half the width of the band.
        guided: ``[*M]`` bool: negative advice means something; ``None``: nowhere.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}
    support = constraints.independent(constraints.real, 1)

    def __init__(
        self,
        loc: Tensor,
        scale: Tensor,
        bound: float = 1.0,
        dead: float = 0.0,
        guided: Tensor | None = None,
        **options: Any,
    ) -> None:
        self.base_dist = Normal(loc, scale, validate_args=False)
        self.bound, self.dead = bound, dead
        none = torch.zeros(loc.shape, dtype=torch.bool, device=loc.device)
        self.guided = none if guided is None else guided.reshape(loc.shape)
        super().__init__(loc.shape[:-1], loc.shape[-1:], validate_args=False)

    @property
    def deterministic_sample(self) -> Tensor:
        """The advice of the median, ``[*M, 1]``."""
        return self.advice(self.base_dist.loc)

    mode = mean = deterministic_sample

    def advice(self, raw: Tensor) -> Tensor:
        """Return the advice that values ``[*, *M, 1]`` of ``x`` stand for."""
        excess = (raw.abs() - self.dead).clamp(0.0, MOST_EXCESS)
        acts = (raw > 0) | self.guided
        return torch.where(acts, self.bound * torch.tanh(excess) * raw.sign(), torch.zeros_like(raw))

    def sample(self, sample_shape: torch.Size | Sequence[int] = ()) -> Tensor:
        """Draw advice ``[*sample_shape, *M, 1]``."""
        return self.advice(self.base_dist.sample(torch.Size(sample_shape)))

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density of advice ``[*, *M, 1]``, or the log-probability of doing nothing where it is 0."""
        return torch.where(value == 0, self.rest_log_prob(), self._log_density(value)).sum(-1)

    def rest_log_prob(self) -> Tensor:
        """Return the log-probability of doing nothing, ``[*M, 1]``."""
        loc, scale = self.base_dist.loc, self.base_dist.scale
        one = torch.special.log_ndtr((self.dead - loc) / scale)
        if not self.guided.any():
            return one
        # The band is symmetric, so it may be looked at from the side where both ends lie in the lower tail.
        far = loc.abs()
        high, low = (torch.special.log_ndtr((end - far) / scale) for end in (self.dead, -self.dead))
        return torch.where(self.guided, high + torch.log1p(-torch.exp((low - high).clamp(max=-1e-6))), one)

    def _log_density(self, value: Tensor) -> Tensor:
        share = (value.abs() / self.bound).clamp(max=math.tanh(MOST_EXCESS))
        raw = (torch.atanh(share) + self.dead) * value.sign()
        return self.base_dist.log_prob(raw) - torch.log1p(-share.square()) - math.log(self.bound)

    def entropy(self) -> Tensor:
        """Return the entropy of the censored normal before the tanh, ``[*M]``: the mass and the density beside it."""
        loc, scale, rest = self.base_dist.loc, self.base_dist.scale, self.rest_log_prob()
        above = _tail_entropy((self.dead - loc) / scale, scale)
        below = _tail_entropy((self.dead + loc) / scale, scale)
        total = above + torch.where(self.guided, below, torch.zeros_like(below)) - rest.exp() * rest
        return total.sum(-1)


def _tail_entropy(z: Tensor, scale: Tensor) -> Tensor:
    """Return minus the integral of ``f log f`` from ``z`` standard deviations above the mean on, for a normal ``f``."""
    beyond = torch.special.ndtr(-z)
    density = torch.exp(-0.5 * z.square() - HALF_LOG_2_PI)
    return (scale.log() + HALF_LOG_2_PI) * beyond + 0.5 * (z * density + beyond)


def normal_of(policy: RestingNormal | TanhNormal) -> Normal:
    """Return the normal behind what a policy would do: before its tanh, or before it is censored."""
    base_dist = policy.base_dist
    return getattr(base_dist, "base_dist", base_dist)
