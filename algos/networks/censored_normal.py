"""A distribution over actions with point masses on 0, the action that leaves a vehicle alone, and on the strongest.

A network's output is censored: every value in a band around its origin stands for the action 0, which has a probability
of its own and no density, and every value beyond a limit for the strongest action. Their log-probabilities are those of
all such values, so the gradient of a policy does not depend on which of the equivalent values was drawn (clipped-action
policy gradient, arXiv 1802.07564).
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
MAX_EXCESS = 4.0
"""Values beyond this stand for the strongest action: a tanh of 0.9993, which single precision can still invert."""
STRONGEST = math.tanh(MAX_EXCESS)
_ROUNDING = 1e-6


class CensoredNormal(Distribution):
    """``bound * tanh(x - half_band)`` of a normal ``x`` above the band ``[-half_band, half_band]``; 0 within it.

    Below the band, the action is ``bound * tanh(x + half_band)`` where ``two_sided``, and 0 elsewhere.

    Args:
        loc, scale: ``[*M, 1]`` of ``x``.
        bound: actions lie between plus and minus this.
        half_band: half the width of the band.
        two_sided: ``[*M]`` bool: actions below 0 differ from 0; ``None``: nowhere.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}
    support = constraints.independent(constraints.real, 1)

    def __init__(
        self,
        loc: Tensor,
        scale: Tensor,
        bound: float = 1.0,
        half_band: float = 0.0,
        two_sided: Tensor | None = None,
        **options: Any,
    ) -> None:
        self.base_dist = Normal(loc, scale, validate_args=False)
        self.bound, self.half_band = bound, half_band
        none = torch.zeros(loc.shape, dtype=torch.bool, device=loc.device)
        self.two_sided = none if two_sided is None else two_sided.reshape(loc.shape)
        super().__init__(loc.shape[:-1], loc.shape[-1:], validate_args=False)

    @property
    def deterministic_sample(self) -> Tensor:
        """The action of the median, ``[*M, 1]``."""
        return self.censor(self.base_dist.loc)

    mode = mean = deterministic_sample

    def censor(self, raw: Tensor) -> Tensor:
        """Return the actions that values ``[*, *M, 1]`` of ``x`` stand for."""
        excess = (raw.abs() - self.half_band).clamp(0.0, MAX_EXCESS)
        acts = (raw > 0) | self.two_sided
        return torch.where(acts, self.bound * torch.tanh(excess) * raw.sign(), torch.zeros_like(raw))

    def sample(self, sample_shape: torch.Size | Sequence[int] = ()) -> Tensor:
        """Draw actions ``[*sample_shape, *M, 1]``."""
        return self.censor(self.base_dist.sample(torch.Size(sample_shape)))

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density of actions ``[*, *M, 1]``; of 0 and of the strongest, the log-probability."""
        strongest = value.abs() >= (1.0 - _ROUNDING) * STRONGEST * self.bound
        some = torch.where(strongest, self._strongest_log_prob(value), self._log_density(value))
        return torch.where(value == 0, self.zero_log_prob(), some).sum(-1)

    def zero_log_prob(self) -> Tensor:
        """Return the log-probability of the action 0, ``[*M, 1]``."""
        loc, scale = self.base_dist.loc, self.base_dist.scale
        one = torch.special.log_ndtr((self.half_band - loc) / scale)
        if not self.two_sided.any():
            return one
        # The band is symmetric, so it may be looked at from the side where both ends lie in the lower tail.
        far = loc.abs()
        high, low = (torch.special.log_ndtr((end - far) / scale) for end in (self.half_band, -self.half_band))
        return torch.where(self.two_sided, high + torch.log1p(-torch.exp((low - high).clamp(max=-1e-6))), one)

    def _log_density(self, value: Tensor) -> Tensor:
        share = (value.abs() / self.bound).clamp(max=STRONGEST)
        raw = (torch.atanh(share) + self.half_band) * value.sign()
        return self.base_dist.log_prob(raw) - torch.log1p(-share.square()) - math.log(self.bound)

    def _strongest_log_prob(self, value: Tensor) -> Tensor:
        """Return the log-probability of the strongest action, on the side of ``value``."""
        beyond = value.sign() * self.base_dist.loc - (MAX_EXCESS + self.half_band)
        return torch.special.log_ndtr(beyond / self.base_dist.scale)

    def entropy(self) -> Tensor:
        """Return the entropy ``[*M]`` of the normal before the tanh, censored around 0 alone: mass and density."""
        loc, scale, rest = self.base_dist.loc, self.base_dist.scale, self.zero_log_prob()
        above = _tail_entropy((self.half_band - loc) / scale, scale)
        below = _tail_entropy((self.half_band + loc) / scale, scale)
        total = above + torch.where(self.two_sided, below, torch.zeros_like(below)) - rest.exp() * rest
        return total.sum(-1)


def _tail_entropy(z: Tensor, scale: Tensor) -> Tensor:
    """Return minus the integral of ``f log f`` from ``z`` standard deviations above the mean on, for a normal ``f``."""
    beyond = torch.special.ndtr(-z)
    density = torch.exp(-0.5 * z.square() - HALF_LOG_2_PI)
    return (scale.log() + HALF_LOG_2_PI) * beyond + 0.5 * (z * density + beyond)


def normal_of(policy: CensoredNormal | TanhNormal) -> Normal:
    """Return the normal distribution of a policy before its tanh and before it is censored."""
    base_dist = policy.base_dist
    return getattr(base_dist, "base_dist", base_dist)
