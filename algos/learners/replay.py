"""Replay for per-agent, off-policy learning: valid agent transitions, flat, in a TorchRL buffer of bounded size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, RandomSampler, Storage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import Sampler

from izoo.algos.learners import base

NEXT_OBSERVATION = ("next", *base.OBSERVATION)
NEXT_REWARD, NEXT_DONE, NEXT_TERMINATED = ("next", *base.REWARD), ("next", *base.DONE), ("next", *base.TERMINATED)
STEPS = "steps_to_next_obs"
"""Environment steps from a row's observation to its successor's; TorchRL's estimators discount by it."""
TRANSITION = (base.OBSERVATION, base.ACTION, NEXT_OBSERVATION, NEXT_REWARD, NEXT_DONE, NEXT_TERMINATED, STEPS)
"""Leaves of a transition; each row stands for one agent in one step."""
ERROR = "td_error"
"""Where a loss leaves the squared errors of a minibatch, ``[n]``."""
PRIORITY_EPS = 1e-6


def transitions(
    batch: TensorDictBase, reward_scale: float = 1.0, n_step: int = 1, gamma: float = 1.0, limit: int | None = None
) -> TensorDict:
    """Flatten a batch ``[N, T]`` to the transitions ``[rows]`` of the slots that held a CV.

    A row leads from an agent's observation and action to the same vehicle ``n_step`` steps later, or where its life or
    the batch ends before. A vehicle that left (terminated) is worth nothing afterwards; one that ran out of time
    (truncated) keeps its true last observation to bootstrap from.

    Args:
        batch: consecutive steps of an environment.
        reward_scale: rewards are multiplied by it.
        n_step: steps whose rewards are summed, discounted by ``gamma``.
        limit: most rows; they are drawn at random.
    """
    where = base.deciding(batch).nonzero()
    if limit is not None:
        where = where[torch.randperm(len(where), device=where.device)[:limit]]
    env, time, slot = where.unbind(-1)
    reward, done = batch.get(NEXT_REWARD), batch.get(NEXT_DONE)
    total, steps = reward[env, time, slot] * reward_scale, torch.ones_like(time)
    going = ~done[env, time, slot].squeeze(-1)
    for ahead in range(1, min(n_step, batch.shape[-1])):
        # The slot holds the same vehicle until it is done, so its rewards can be read down the time axis.
        going = going & (time + ahead < batch.shape[-1])
        e, t, s = env[going], time[going] + ahead, slot[going]
        total[going] += reward[e, t, s] * (reward_scale * gamma**ahead)
        steps[going] += 1
        going[going.clone()] = ~done[e, t, s].squeeze(-1)
    last = env, time + steps - 1, slot
    gone, following = batch.get(NEXT_TERMINATED)[last], batch.get(NEXT_OBSERVATION)[last]
    flat = TensorDict(batch_size=[len(where)], device=where.device)
    flat.set(base.OBSERVATION, batch.get(base.OBSERVATION)[env, time, slot])
    flat.set(base.ACTION, batch.get(base.ACTION)[env, time, slot])
    # No vehicle is observed there; the content of the slot must not reach a network, since 0 x NaN is NaN.
    flat.set(NEXT_OBSERVATION, torch.where(gone, torch.zeros_like(following), following))
    flat.set(NEXT_REWARD, total)
    flat.set(NEXT_DONE, done[last])
    flat.set(NEXT_TERMINATED, gone)
    return flat.set(STEPS, steps.unsqueeze(-1))


class PriorityDraws(Sampler):
    """Draws with probability proportional to ``priority ** alpha`` (Schaul et al., arXiv 1511.05952).

    TorchRL's ``PrioritizedSampler`` does the same in O(log n) by trees in its compiled extension, which loads with some
    builds of PyTorch alone and cannot be written to a checkpoint; at tens of thousands of rows a sum is as fast.

    Args:
        capacity: most rows held.
        alpha: exponent of the priorities.
        beta: exponent of the weights that correct for drawing by priority, the largest of which is 1.
    """

    def __init__(self, capacity: int, alpha: float, beta: float) -> None:
        super().__init__()
        self.alpha, self.beta = alpha, beta
        self.priority = torch.zeros(capacity, dtype=torch.float64)

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Return rows' indices ``[batch_size]``, and their weights as ``priority_weight``."""
        held = self.priority[: len(storage)] ** self.alpha
        bounds = held.cumsum(0)
        drawn = torch.rand(batch_size, dtype=bounds.dtype) * bounds[-1]
        index = torch.searchsorted(bounds, drawn, right=True).clamp_max(len(held) - 1)
        weight = (held[index] / held.min()) ** -self.beta
        return index, {"priority_weight": weight.float()}

    def extend(self, index: Tensor) -> None:
        """Give new rows the highest priority so far, so that each is likely to be seen soon."""
        self.priority[index] = self.priority.max() if self.priority.any() else 1.0

    def update_priority(self, index: Tensor, priority: Tensor, *, storage: Storage | None = None) -> None:
        """Set the priorities of rows."""
        self.priority[index] = priority.to(self.priority.dtype) + PRIORITY_EPS

    def state_dict(self) -> dict[str, Any]:
        """Return the priorities."""
        return {"priority": self.priority.clone()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.priority.copy_(state_dict["priority"])

    def _empty(self) -> None:
        self.priority.zero_()

    def dumps(self, path: Path | str) -> None:
        """Write the priorities to a file."""
        torch.save(self.state_dict(), path)

    def loads(self, path: Path | str) -> None:
        """Read what :meth:`dumps` wrote."""
        self.load_state_dict(torch.load(path, weights_only=True))


class Replay:
    """The newest ``capacity`` transitions, drawn uniformly or by priority.

    Memory: ``capacity * (8 * F + 18)`` bytes for observations of ``F`` features, taken at the first :meth:`add`.

    Args:
        capacity: most transitions held.
        minibatch_rows: transitions per draw.
        alpha, beta: of :class:`PriorityDraws`; an ``alpha`` of 0 draws uniformly.
        device: where the transitions are held and drawn; priorities stay on the CPU.
    """

    def __init__(
        self,
        capacity: int,
        minibatch_rows: int,
        alpha: float = 0.0,
        beta: float = 0.4,
        device: torch.device | str = "cpu",
    ) -> None:
        self.sampler = PriorityDraws(capacity, alpha, beta) if alpha > 0 else RandomSampler()
        self.capacity = capacity
        self.buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(capacity, device=device), sampler=self.sampler, batch_size=minibatch_rows
        )

    def __len__(self) -> int:
        return len(self.buffer)

    def add(self, rows: TensorDictBase) -> None:
        """Store transitions ``[rows]``; the oldest make room."""
        if len(rows) > 0:
            self.buffer.extend(rows[-self.capacity :])

    def sample(self) -> TensorDictBase:
        """Draw a minibatch, with the leaves ``index`` and, by priority, ``priority_weight``."""
        return self.buffer.sample()

    def learned(self, minibatch: TensorDictBase) -> None:
        """Set the priorities of a minibatch to its absolute errors, from what the loss left in :data:`ERROR`."""
        if isinstance(self.sampler, PriorityDraws):
            self.sampler.update_priority(minibatch.get("index").cpu(), minibatch.get(ERROR).sqrt().cpu())

    def state_dict(self) -> dict[str, Any]:
        """Return the transitions, their priorities and the place of the next one."""
        if len(self) == 0:
            return {}
        held = self.buffer[: len(self)]
        return {
            "rows": {_name(key): held.get(key).clone() for key in TRANSITION},
            "sampler": self.sampler.state_dict(),
            "writer": self.buffer.writer.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned; what was held before goes."""
        self.buffer.empty()
        if not state:
            return
        rows = TensorDict(batch_size=[len(state["rows"][STEPS])])
        for key in TRANSITION:
            rows.set(key, state["rows"][_name(key)])
        self.buffer.extend(rows)
        self.sampler.load_state_dict(state["sampler"])
        self.buffer.writer.load_state_dict(state["writer"])


def _name(key: str | tuple[str, ...]) -> str:
    return key if isinstance(key, str) else "/".join(key)
