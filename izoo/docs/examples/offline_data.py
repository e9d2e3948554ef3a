"""Offline data: store what glide does, clone it from the stored steps, and say how far the clone falls short of it.

The same data from the shell: ``python -m izoo.collect policy=glide frames=20000 out=DIR``.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.data import TensorDictReplayBuffer

from izoo import collect
from izoo.conf.context_choices import PcgContexts
from izoo.envs import EnvConfig
from izoo.results import evaluate_policy, print_summary, summarise
from izoo.results.selection import choose_contexts

TRAFFIC: dict[str, Any] = {
    "lane_count": 1,
    "phase_count": 1,
    "inflow_vph_per_lane": "400..600",
    "green_s": "20..26",
    "red_s": "24..32",
    "lane_length_m": "250..500",
}
"""One-lane approaches near capacity, those of the task ``busy_lane``."""


def transitions(steps: TensorDictBase) -> TensorDict:
    """Flatten steps ``[T]`` with ``[A]`` slots into one transition per controlled vehicle and step.

    ``terminated``: the vehicle left, there is no next value. Horizon and leaving apart, slot ``k`` of ``next`` is the
    same vehicle as slot ``k``, so masking the root with its mask is all that is needed.
    """
    mask, agents, following = steps["agents", "mask"], steps["agents"], steps["next", "agents"]
    columns = {name: agents[name][mask] for name in ("observation", "action", "defer")}
    columns["next"] = TensorDict(
        {name: following[name][mask] for name in ("observation", "reward", "done", "terminated")}, [int(mask.sum())]
    )
    return TensorDict(columns, [int(mask.sum())])


class Clone(nn.Module):
    """A policy that predicts the driver's acceleration, and whether it leaves the vehicle to the simulator."""

    def __init__(self) -> None:
        super().__init__()
        self.network = nn.Sequential(nn.LazyLinear(128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh(), nn.Linear(128, 2))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``("agents", "action")`` ``[*B, A, 1]`` in m/s^2 and ``("agents", "defer")`` ``[*B, A]``."""
        found = self.network(tensordict["agents", "observation"])
        tensordict["agents", "action"] = found[..., :1]
        return tensordict.set(("agents", "defer"), found[..., 1] > 0.0)

    def loss(self, batch: TensorDictBase) -> torch.Tensor:
        """Squared error of the commanded accelerations, and cross-entropy of leaving the vehicle alone."""
        found, defer = self.network(batch["observation"]), batch["defer"]
        error = (found[:, 0] - batch["action"][:, 0]).square()
        left_alone = nn.functional.binary_cross_entropy_with_logits(found[:, 1], defer.float())
        return torch.where(defer, torch.zeros_like(error), error).mean() + left_alone


def fit(buffer: TensorDictReplayBuffer, updates: int) -> tuple[Clone, list[float]]:
    """Fit a clone to the driver's commands; return it and the losses."""
    clone = Clone()
    losses: list[float] = []
    clone.network(transitions(buffer[:1])["observation"])
    optimiser = torch.optim.Adam(clone.parameters(), lr=1e-3)
    while len(losses) < updates:
        batch = transitions(buffer.sample())
        if len(batch) == 0:  # steps without controlled vehicles
            continue
        loss = clone.loss(batch)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    print(f"loss {losses[0]:.3f} -> {losses[-1]:.3f}")
    return clone.eval(), losses


def main(
    frames: int = 20_000, updates: int = 3000, horizon_s: float = 500.0, contexts: int = 8, cache: Path | None = None
) -> tuple[list[float], dict[str, Any]]:
    """Collect, load, clone, and evaluate on other contexts; return the losses and the summary."""
    with tempfile.TemporaryDirectory() as folder:
        data, results = Path(folder) / "data", Path(folder) / "results"
        traffic = [f"contexts.{name}={value}" for name, value in TRAFFIC.items()]
        options = [f"frames={frames}", f"out={data}", f"env.horizon_s={horizon_s}", "env.num_agents=32", *traffic]
        if collect.main(["policy=glide", *options]) != 0:
            raise SystemExit(1)
        buffer = collect.replay_buffer(data, batch_size=256)
        print(f"{len(buffer)} steps with {len(buffer.storage.rows)} rows of agents")
        clone, losses = fit(buffer, updates)
        played = choose_contexts(PcgContexts(**TRAFFIC).build(), contexts, seed=1)
        config = EnvConfig(horizon_s=horizon_s, num_agents=32)
        evaluate_policy("glide", played, [0], config, out=results, cache=cache)
        summary = summarise(evaluate_policy(clone, played, [0], config, name="clone", out=results, cache=cache))
    print_summary(summary)
    (pair,) = summary["pairwise"]  # the first entry less the second, intersection by intersection
    value, ends = pair["difference"]["value"], [pair["difference"][end] for end in ("low", "high")]
    interval = "" if None in ends else f" [{ends[0]:.1f}, {ends[1]:.1f}]"
    print(f"{pair['x']} less {pair['y']}: {value:+.1f} points of CO2 saved{interval}, {pair['verdict']}.")
    return losses, summary


if __name__ == "__main__":
    main()
