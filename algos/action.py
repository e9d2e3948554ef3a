"""What the action of a learned policy stands for: the options ``action=direct`` and ``action=residual``."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, EnvConfig
from izoo.errors import check_range

if TYPE_CHECKING:
    from izoo.algos.base import Algorithm

Build = Callable[[Any, int, float, float], "Algorithm"]
"""What builds an algorithm from its options, the length of an observation, and the bounds of its action."""


@dataclass(frozen=True)
class DirectAction:
    """The policy's action is the acceleration.

    Attributes:
        name: the action mode.
    """

    name: Literal["direct"] = "direct"

    def algorithm(self, build: Build, config: Any, features: int, env: EnvConfig) -> Algorithm:
        """Return the algorithm that ``build`` makes."""
        return build(config, features, ACTION_LOW_MPS2, ACTION_HIGH_MPS2)


@dataclass(frozen=True)
class ResidualAction:
    """The policy's action is added to the acceleration of the nominal controller.

    Attributes:
        name: the action mode.
        half_width_mps2: the residual lies between plus and minus this. 1 m/s^2 is as much as glide itself commands, so
            that it can be overruled where it brakes for nothing, and no more.
        threshold_mps2: a CV that glide leaves alone stays with the simulator's driver unless its residual is below
            minus this, so that what is not yet learned disturbs nobody.
    """

    name: Literal["residual"] = "residual"
    half_width_mps2: float = 1.0
    threshold_mps2: float = 0.1

    def __post_init__(self) -> None:
        check_range("action.half_width_mps2", self.half_width_mps2, 0.01, ACTION_HIGH_MPS2 - ACTION_LOW_MPS2, "m/s^2")
        check_range("action.threshold_mps2", self.threshold_mps2, 0.0, self.half_width_mps2, "m/s^2")

    def algorithm(self, build: Build, config: Any, features: int, env: EnvConfig) -> Algorithm:
        """Return the algorithm that ``build`` makes for residuals, which start at 0 whatever its options say."""
        from izoo.algos.residual import NominalDriver, Residual

        config = dataclasses.replace(config, initial_accel_mps2=0.0)
        learned = build(config, features, -self.half_width_mps2, self.half_width_mps2)
        return Residual(learned, NominalDriver(env), self.threshold_mps2)


ActionConfig = DirectAction | ResidualAction
