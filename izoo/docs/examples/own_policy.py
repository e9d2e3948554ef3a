"""An own policy in izoo's evaluation: paired with human driving, same demand, drivers and seeds."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import torch
from tensordict import TensorDictBase

from izoo.contexts.procedural import procedural_context
from izoo.envs import EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.envs.mdp.observation import DISTANCE_SCALE_M, SPEED_SCALE_MPS, TIME_SCALE_S
from izoo.results import evaluate_policy, print_summary, summarise

CONFIG = EnvConfig()
COLUMN = {name: column for column, name in enumerate(observation_names(CONFIG))}


class ArriveOnGreen:
    """Facing a red light, slow down early so as to arrive when it turns green; otherwise leave the driving to SUMO.

    A policy is any callable that maps a TensorDict with ``("agents", "observation")`` ``[A, F]`` and
    ``("agents", "mask")`` ``[A]`` to one with ``("agents", "action")`` ``[A, 1]`` in m/s^2. With
    ``("agents", "defer")`` ``[A]`` it leaves CVs to SUMO.
    """

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        seen = tensordict["agents", "observation"]
        speed = seen[..., COLUMN["speed"]] * SPEED_SCALE_MPS
        distance = -seen[..., COLUMN["stop_line_distance"]] * DISTANCE_SCALE_M
        left = seen[..., COLUMN["signal_time_left"]] * TIME_SCALE_S
        advised = (distance / left.clamp_min(1.0)).clamp(4.0, 20.0)
        waits = (seen[..., COLUMN["signal_red"]] > 0.5) & (distance > 20.0) & (advised < speed)
        action = ((advised - speed) / 2.0).clamp(-1.5, 0.0)
        tensordict["agents", "action"] = torch.where(waits, action, torch.zeros_like(action)).unsqueeze(-1)
        return tensordict.set(("agents", "defer"), ~waits)


def main(
    horizon_s: float = 1000.0, seeds: tuple[int, ...] = (0, 1, 2), num_workers: int = 2, cache: Path | None = None
) -> pd.DataFrame:
    """Evaluate on two contexts; return one row per policy, context, seed and approach."""
    contexts = [procedural_context(inflow_vph_per_lane=inflow, adoption=0.5) for inflow in (250.0, 400.0)]
    table = evaluate_policy(
        ArriveOnGreen(),
        contexts,
        seeds,
        EnvConfig(horizon_s=horizon_s),
        workers=num_workers,
        progress=False,
        name="arrive-on-green",
        cache=cache,
    )
    print_summary(summarise(table))
    return table


if __name__ == "__main__":
    main()
