"""Offline data: store what a driver experiences in shards, then sample agent-steps from them without loading them.

The same data from the shell: ``python -m izoo.collect policy=glide frames=20000 out=DIR``.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.data import TensorDictReplayBuffer

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
        if collect.main(["policy=random", f"shard_frames={frames // 2}", *options]) != 0:
            raise SystemExit(1)
        buffer = collect.replay_buffer(data, batch_size=64)
        print(f"{len(buffer)} steps lie in {len(buffer.storage.shards)} shards")
        return clone(buffer, updates)


def clone(buffer: TensorDictReplayBuffer, updates: int) -> list[float]:
    """Fit a network to the driver's actions; return the losses."""
    network = nn.Sequential(nn.LazyLinear(64), nn.Tanh(), nn.Linear(64, 1))
    network(transitions(buffer[:1])["observation"])
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)
    losses: list[float] = []
    while len(losses) < updates:
        batch = transitions(buffer.sample())
        if len(batch) == 0:  # steps without controlled vehicles
            continue
        loss = nn.functional.mse_loss(network(batch["observation"]), batch["action"])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    print(f"squared error {losses[0]:.3f} -> {losses[-1]:.3f}")
    return losses


if __name__ == "__main__":
    main()
