"""The action mode ``action=arrive``: when to arrive at the stop line.

A learned policy chooses how late in a green a vehicle should arrive, and how much slower than the limit it should drive
behind the line. Both become desired speeds, one before and one behind the line.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from izoo.algos.drivers.signal_timing import greens
from izoo.algos.learners import base
from izoo.contexts.features import feature
from izoo.envs.config import MIN_SHARE, EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.envs.mdp.observation import DISTANCE_SCALE_M
from izoo.errors import IzooError

LATENESS = ("agents", "lateness")
"""``[*B, A, D]`` in [0, 1]: the learned policy's action, two numbers or three."""


class Arrival(nn.Module):
    """Turns lateness into desired speeds: 0 is early and unhindered behind the line, 1 is as late as possible.

    A third number becomes the part ``stop`` of the action: 0 leaves stops to the driver, 1 is the gentlest.

    A vehicle aims for its share of the first green that it can reach at the speed limit. Queues are ignored: the policy
    has to learn about them.

    Args:
        config: settings of the environment; the features ``green_s``, ``red_s`` and ``speed_limit_mps`` must be
            observed.
        slowest: no desired speed is a smaller share of the limit.
    """

    def __init__(self, config: EnvConfig, slowest: float) -> None:
        super().__init__()
        self.slowest = slowest
        names = observation_names(config)
        missing = [name for name in ("green_s", "red_s", "speed_limit_mps") if f"context_{name}" not in names]
        if missing:
            raise IzooError(f"action=arrive needs {', '.join(missing)} in the observation; add it to env.observed.")
        self.columns = {name: column for column, name in enumerate(names)}

    def forward(self, observation: Tensor, lateness: Tensor) -> Tensor:
        """Return the action, ``[*B, A, D]``: shares of the limit before and behind the stop line, and of braking.

        Args:
            observation: ``[*B, A, F]``.
            lateness: ``[*B, A, D]``.
        """
        limit = observation[..., self.columns["context_speed_limit_mps"]] * feature("speed_limit_mps").scale
        distance = -observation[..., self.columns["stop_line_distance"]] * DISTANCE_SCALE_M
        free_s = distance / limit.clamp_min(1.0)
        arrival_s = self.arrival(observation, free_s, lateness[..., 0])
        before = torch.where(free_s > 0.0, free_s / arrival_s.clamp_min(0.1), torch.ones_like(free_s))
        behind = 1.0 - (1.0 - self.slowest) * lateness[..., 1]
        speeds = torch.stack([before, behind], -1).clamp(self.slowest, 1.0)
        return torch.cat([speeds, 1.0 - (1.0 - MIN_SHARE) * lateness[..., 2:]], -1)

    def arrival(self, observation: Tensor, free_s: Tensor, late: Tensor) -> Tensor:
        """Return in how many seconds vehicles should arrive, ``[*B, A]``.

        Args:
            observation: ``[*B, A, F]``.
            free_s: ``[*B, A]`` seconds to the stop line at the limit.
            late: ``[*B, A]`` share of the green that should have passed.
        """
        starts, length = greens(observation, self.columns)
        found = torch.full_like(free_s, torch.inf)
        for start in starts:
            aim = torch.maximum(start + late * length, free_s)
            found = torch.where(torch.isinf(found) & (aim <= start + length), aim, found)
        return torch.where(torch.isinf(found), free_s, found)


class ArrivingPolicy(TensorDictModuleBase):
    """A learned policy whose action becomes :data:`LATENESS`; the action is the desired speeds that follow from it.

    Args:
        learned: writes ``("agents", "action")`` ``[*B, A, D]``.
        arrival: turns it into speeds.
    """

    def __init__(self, learned: TensorDictModuleBase, arrival: Arrival) -> None:
        super().__init__()
        self.learned, self.arrival = learned, arrival
        self.in_keys = list(dict.fromkeys([*learned.in_keys, base.OBSERVATION]))
        self.out_keys = [*learned.out_keys, LATENESS]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write lateness and speeds, and what else the learned policy writes."""
        lateness = self.learned(tensordict).get(base.ACTION)
        speeds = self.arrival(tensordict.get(base.OBSERVATION), lateness)
        return tensordict.set(LATENESS, lateness).set(base.ACTION, speeds)


class Arriving(base.AlgorithmWrapper):
    """An algorithm whose actions are lateness; see :class:`izoo.algos.learners.base.Algorithm`.

    Args:
        learned: the algorithm, built for actions ``[0, 1]^D``.
        arrival: turns its actions into speeds.
    """

    def __init__(self, learned: base.Algorithm, arrival: Arrival) -> None:
        super().__init__(learned, ArrivingPolicy(learned.policy, arrival))

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Learn from the batch with lateness as its action; the batch itself is not changed."""
        return self.learned.update(batch.copy().set(base.ACTION, batch.get(LATENESS)), progress)
