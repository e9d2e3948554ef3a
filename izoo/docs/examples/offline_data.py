"""Offline data: store what a driver experiences, then sample agent-steps from a replay buffer.

The same data from the shell: ``python -m izoo.collect policy=glide frames=20000 out=DIR``.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from izoo import collect


def transitions(steps: TensorDictBase) -> TensorDict:
    """Flatten steps ``[T]`` with ``[A]`` slots into one transition per controlled vehicle and step.

    ``terminated``: the vehicle left, there is no next value. Horizon and leaving apart, slot ``k`` of ``next`` is the
    same vehicle as slot ``k``, so masking the root with its mask is all that is needed.
    """
    mask, agents, following = steps["agents", "mask"], steps["agents"], steps["next", "agents"]
    columns = {name: agents[name][mask] for name in ("observation", "action")}
    columns["next"] = TensorDict(
        {name: following[name][mask] for name in ("observation", "reward", "done", "terminated")}, [int(mask.sum())]
    )
    return TensorDict(columns, [int(mask.sum())])


def main(frames: int = 20_000, updates: int = 1000, horizon_s: float = 500.0, out: Path | None = None) -> list[float]:
    """Collect, load, and clone the driver's behaviour; return the losses."""
    with tempfile.TemporaryDirectory() as folder:
        data = out or Path(folder) / "data"
        options = [f"frames={frames}", f"out={data}", f"env.horizon_s={horizon_s}", "env.emit=[]", "contexts=pcg_easy"]
        if collect.main(["policy=random", *options]) != 0:
            raise SystemExit(1)
        rows = transitions(collect.load(data))
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(rows)), batch_size=256)
    buffer.extend(rows)
    print(f"{frames} steps hold {len(rows)} agent-steps")
    network = nn.Sequential(nn.Linear(rows["observation"].shape[-1], 64), nn.Tanh(), nn.Linear(64, 1))
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)
    losses = []
    for _ in range(updates):
        batch = buffer.sample()
        loss = nn.functional.mse_loss(network(batch["observation"]), batch["action"])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    print(f"squared error {losses[0]:.3f} -> {losses[-1]:.3f}")
    return losses


if __name__ == "__main__":
    main()
