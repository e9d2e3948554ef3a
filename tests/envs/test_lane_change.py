"""Commanded lane changes move vehicles, and nobody collides."""

from __future__ import annotations

import contextlib

import torch
from tensordict import TensorDictBase

from izoo.envs import EcoDrivingEnv
from izoo.networks.road import APPROACHING
from tests.envs.worlds import crossing, play, set_action, short

RIGHT, KEEP, LEFT = range(3)


def drive(command: int) -> tuple[float, float]:
    """Give every CV the same command; return the mean lane index of approaching CVs, and its mean change in a step."""

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        mask = tensordict["agents", "mask"]
        tensordict["agents", "lane_change"] = torch.full(mask.shape, command)
        return set_action(tensordict, torch.ones(*mask.shape, 1))

    with contextlib.closing(
        EcoDrivingEnv(
            crossing(lane_count=3, lane_length_m=250.0, inflow_vph_per_lane=200.0, adoption=1.0),
            config=short(lane_change=True, horizon_s=100.0),
        )
    ) as env:
        frames = play(env, env.config.control_steps, act)
        collisions = frames["next", "metrics", "episode", "collisions"][-1].item()
    before, after = frames["vehicles"], frames["next", "vehicles"]
    there = before["present"] & after["present"] & (before["vehicle_number"] == after["vehicle_number"])
    there &= (before["location"] == APPROACHING) & (after["location"] == APPROACHING)
    assert collisions == 0
    moved = (after["lane"] - before["lane"])[there]
    return float(after["lane"][there].float().mean()), float(moved.float().mean())


def test_commands_move_vehicles() -> None:
    right, keep, left = (drive(command) for command in (RIGHT, KEEP, LEFT))
    assert right[0] < keep[0] - 0.1 < left[0] - 0.2
    assert right[1] < keep[1] < left[1]
