"""Columns of observations by name, in their units, and what rules read from several of them."""

from __future__ import annotations

import torch
from torch import Tensor

from izoo.envs.config import EnvConfig
from izoo.envs.mdp.observation import observation_columns
from izoo.errors import IzooError


class Observed:
    """Reads columns of observations ``[*B, A, F]`` in their units, ``[*B, A]`` each.

    Args:
        config: settings of the environment.
        needed: columns that must be observed besides those that always are.
        by: what needs them, for the message.
    """

    def __init__(self, config: EnvConfig, needed: tuple[str, ...] = (), by: str = "") -> None:
        columns = observation_columns(config.neighbours, config.observed)
        self.columns = {column.name: (place, column.scale) for place, column in enumerate(columns)}
        missing = [name for name in needed if name not in self.columns]
        if missing:
            features = [name.removeprefix("context_") for name in missing if name.startswith("context_")]
            others = [name.removesuffix("_present") for name in missing if not name.startswith("context_")]
            places = {"env.observed": features, "env.neighbours": others}
            remedies = [f"add {', '.join(names)} to {option}" for option, names in places.items() if names]
            raise IzooError(f"{by} needs {', '.join(missing)} in the observation; {' and '.join(remedies)}.")

    def __call__(self, observation: Tensor, name: str) -> Tensor:
        """Return a column in its unit."""
        place, scale = self.columns[name]
        return observation[..., place] * scale

    def flag(self, observation: Tensor, name: str) -> Tensor:
        """Return a column of yes and no, bool."""
        return observation[..., self.columns[name][0]] > 0.5

    def greens(self, observation: Tensor) -> tuple[list[Tensor], Tensor]:
        """Return in how many seconds the next three greens of each CV's movement begin, and how long they last; one
        that has begun counts from below 0. The features ``green_s`` and ``red_s`` must be observed."""
        left, second, third = (
            self(observation, f"signal_{name}") for name in ("time_left", "second_green", "third_green")
        )
        length = self(observation, "context_green_s")
        cycle = length + self(observation, "context_red_s")
        # On yellow the time left is that of the yellow, so the first green follows from the second.
        late = torch.where(self.flag(observation, "signal_red"), left, (second - cycle).clamp_min(0.0))
        return [torch.where(self.flag(observation, "signal_green"), left - length, late), second, third], length
