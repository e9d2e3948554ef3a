"""When the next greens of a vehicle's movement begin, read from its observation."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from izoo.contexts.features import feature
from izoo.envs.mdp.observation import TIME_SCALE_S


def greens(observation: Tensor, columns: Mapping[str, int]) -> tuple[list[Tensor], Tensor]:
    """Return in how many seconds the next three greens of each CV's movement begin, and how long they last, ``[*B, A]``
    each; one that has begun counts from below 0.

    Args:
        observation: ``[*B, A, F]``.
        columns: places of its features; ``green_s`` and ``red_s`` must be among them.
    """

    def column(name: str, scale: float = 1.0) -> Tensor:
        return observation[..., columns[name]] * scale

    left, second, third = (
        column(f"signal_{name}", TIME_SCALE_S) for name in ("time_left", "second_green", "third_green")
    )
    length = column("context_green_s", feature("green_s").scale)
    cycle = length + column("context_red_s", feature("red_s").scale)
    # On yellow the time left is that of the yellow, so the first green follows from the second.
    late = torch.where(column("signal_red") > 0.5, left, (second - cycle).clamp_min(0.0))
    return [torch.where(column("signal_green") > 0.5, left - length, late), second, third], length
