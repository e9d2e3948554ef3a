"""The action mode ``action=arrive``: when to arrive at the stop line.

A learned policy chooses how late in a green a vehicle should arrive, and how much slower than the limit it should drive
behind the line. Both become desired speeds, one before and one behind the line.
"""

from __future__ import annotations

import torch
from torch import Tensor

from izoo.algos.actions.action_wrappers import ActionTransform
from izoo.algos.drivers.observed import Observed
from izoo.envs.config import MIN_SHARE, EnvConfig


class Arrival(ActionTransform):
    """Turns lateness into desired speeds: 0 is early and unhindered behind the line, 1 is as late as possible.

    A third number becomes the part ``stop`` of the action: 0 leaves stops to the driver, 1 is the gentlest.

    A vehicle aims for its share of the first green that it can reach at the speed limit. Queues are ignored: the policy
    has to learn about them.

    Args:
        config: settings of the environment; the features ``green_s``, ``red_s`` and ``speed_limit_mps`` must be
            observed.
        slowest: no desired speed is a smaller share of the limit.
    """

    defers = False

    def __init__(self, config: EnvConfig, slowest: float) -> None:
        super().__init__()
        self.slowest = slowest
        features = ("green_s", "red_s", "speed_limit_mps")
        self.seen = Observed(config, tuple(f"context_{name}" for name in features), "action=arrive")

    def look(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, ...]:
        return (observation,)

    def command(self, seen: tuple[Tensor, ...], raw: Tensor) -> tuple[Tensor, None]:
        """Return shares of the limit before and behind the stop line, and of braking, ``[*B, A, D]``."""
        (observation,) = seen
        limit = self.seen(observation, "context_speed_limit_mps")
        free_s = -self.seen(observation, "stop_line_distance") / limit.clamp_min(1.0)
        arrival_s = self.arrival(observation, free_s, raw[..., 0])
        before = torch.where(free_s > 0.0, free_s / arrival_s.clamp_min(0.1), torch.ones_like(free_s))
        behind = 1.0 - (1.0 - self.slowest) * raw[..., 1]
        speeds = torch.stack([before, behind], -1).clamp(self.slowest, 1.0)
        return torch.cat([speeds, 1.0 - (1.0 - MIN_SHARE) * raw[..., 2:]], -1), None

    def arrival(self, observation: Tensor, free_s: Tensor, late: Tensor) -> Tensor:
        """Return in how many seconds vehicles should arrive, ``[*B, A]``.

        Args:
            observation: ``[*B, A, F]``.
            free_s: ``[*B, A]`` seconds to the stop line at the limit.
            late: ``[*B, A]`` share of the green that should have passed.
        """
        starts, length = self.seen.greens(observation)
        found = torch.full_like(free_s, torch.inf)
        for start in starts:
            aim = torch.maximum(start + late * length, free_s)
            found = torch.where(torch.isinf(found) & (aim <= start + length), aim, found)
        return torch.where(torch.isinf(found), free_s, found)
