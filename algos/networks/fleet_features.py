"""All vehicles of the region, human-driven ones too, as numbers of a fixed length: for critics that see them.

A picture of the road: how many vehicles there are on each stretch of each approach, how fast they are, how many stand,
and how many are controlled. It is a sum over the set, so neither the order nor the number of slots matters.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

FLEET = ("agents", "fleet")
"""Key of the picture, repeated for every agent slot of its frame, ``[*B, A, FLEET_WIDTH]``."""
COLUMNS = ("speed_mps", "path_position_m", "approach", "is_cv", "present")
"""Entries of ``("vehicles", name)`` that are looked at."""
APPROACHES = 6
"""Vehicles from further approaches are counted with those of the last."""
STRETCHES_M = (-200.0, -120.0, -80.0, -50.0, -30.0, -15.0, 0.0)
"""Where stretches end, along the route; 0 is the stop line, and one more stretch lies beyond it."""
CHANNELS, COUNT_SCALE, SPEED_SCALE_MPS, STANDING_MPS = 4, 5.0, 15.0, 1.0
FLEET_WIDTH = APPROACHES * (len(STRETCHES_M) + 1) * CHANNELS


def fleet_picture(vehicles: TensorDictBase) -> Tensor:
    """Return ``[*B, FLEET_WIDTH]`` of vehicle slots ``[*B, V]``; empty slots do not count, whatever they hold."""
    present = vehicles.get("present")
    speed, position = (torch.where(present, vehicles.get(name), 0.0) for name in ("speed_mps", "path_position_m"))
    stretch = torch.bucketize(position, torch.tensor(STRETCHES_M, device=position.device))
    approach = torch.where(present, vehicles.get("approach"), 0).long().clamp(0, APPROACHES - 1)
    cell = approach * (len(STRETCHES_M) + 1) + stretch
    channels = (present, speed / SPEED_SCALE_MPS, present & (speed < STANDING_MPS), present & vehicles.get("is_cv"))
    parts = []
    for channel in channels:
        empty = speed.new_zeros(*speed.shape[:-1], FLEET_WIDTH // CHANNELS)
        parts.append(empty.scatter_add(-1, cell, channel.to(speed.dtype)))
    return torch.cat(parts, -1) / COUNT_SCALE


def add_fleet(batch: TensorDictBase) -> None:
    """Set :data:`FLEET` in a batch ``[*B]`` that holds ``"vehicles"``, and under ``"next"``; slots share memory."""
    for part in (batch, batch.get("next")):
        slots = part.get(("agents", "mask")).shape[-1]
        picture = fleet_picture(part.get("vehicles")).unsqueeze(-2)
        part.set(FLEET, picture.expand(*picture.shape[:-2], slots, FLEET_WIDTH))
