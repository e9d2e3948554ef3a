"""Decisions out of steps: what learners see where agents do not decide in every step.

With ``env.decide=vehicle`` an action stays in force for many steps, of which only the first asks for it. From batches
``[N, T]`` of consecutive steps, :class:`Decisions` makes one entry per decision, as soon as it has ended: the frame in
which it was taken, the frame in which it ended, and the sum of its rewards. Losses, value estimators and replays take
these entries as they take steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from izoo.algos.learners import base

NEXT_REWARD = ("next", *base.REWARD)


class Decisions:
    """Turns batches of steps into batches of the decisions that have ended; a ``postproc`` of TorchRL's collectors.

    An agent's decision ends where it decides again, leaves (``terminated``) or its episode ends (``truncated``). One
    that has not ended with its batch is kept, and comes with a later one.

    Args:
        whole: keep whole frames ``[K, 1, A]``, of which ``("agents", "decides")`` marks the agents that decided, for
            networks in which agents interact; else only the agent itself, ``[K, 1, 1]``.

    Attributes:
        open: decisions ``[M]`` that have not ended, with their environments and slots.
    """

    def __init__(self, whole: bool = False) -> None:
        self.whole = whole
        self.open: TensorDictBase | None = None

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Take in consecutive steps ``[N, T]`` (or ``[T]``) of the same environments, and return what ended in them.

        Returns:
            ``[K, 1]``; ``("next", "agents", "reward")`` is a decision's sum, and all else under ``"next"`` is of the
            step in which it ended.
        """
        steps = batch if batch.ndim == 2 else batch.unsqueeze(0)
        length = steps.shape[1]
        ends = steps.get(("next", *base.DONE)).squeeze(-1) | steps.get(("next", *base.DECIDES))
        ends_at = torch.where(ends, torch.arange(length, device=ends.device).view(1, -1, 1), length)
        ends_at = ends_at.flip(1).cummin(1).values.flip(1)
        reward = steps.get(NEXT_REWARD).squeeze(-1).double()
        reward_sum = torch.cat([torch.zeros_like(reward[:, :1]), reward.cumsum(1)], 1)

        begun = self._begun(steps)
        if self.open is not None and len(self.open) > 0:
            begun = torch.cat([self.open, begun])
        env, begin, slot = (begun.get(name) for name in ("env", "begin", "slot"))
        end = ends_at[env, begin, slot]
        ended = end < length
        last = end.clamp_max(length - 1)
        begun.set(
            "reward_sum", begun.get("reward_sum") + reward_sum[env, last + 1, slot] - reward_sum[env, begin, slot]
        )

        closed, last = begun[ended], last[ended]
        self.open = begun[~ended].set("begin", torch.zeros_like(begin[~ended]))
        own = closed.get("env"), last, closed.get("slot")
        following = self._frames(steps.get("next"), *own)
        following.get("agents").set("reward", self._reward_sum(closed, following))
        for name in ("done", "terminated", "truncated"):
            flag = steps.get(("next", "agents", name))[own]
            following.set(name, flag)
        return closed.get("frame").set("next", following).unsqueeze(1)

    def _begun(self, steps: TensorDictBase) -> TensorDict:
        """Return the decisions that begin in a batch."""
        decides = steps.get(base.MASK) & steps.get(base.DECIDES)
        env, begin, slot = decides.nonzero(as_tuple=True)
        frame = self._frames(steps.exclude("next"), env, begin, slot)
        where = {"env": env, "begin": begin, "slot": slot, "reward_sum": torch.zeros_like(env, dtype=torch.float64)}
        return TensorDict({**where, "frame": frame}, [len(env)], device=env.device)

    def _frames(self, steps: TensorDictBase, env: Tensor, step: Tensor, slot: Tensor) -> TensorDict:
        """Return the frames ``[M]`` in which agents were, whole or of the agents alone."""
        if self.whole:
            frames = steps[env, step].clone()
            decides = torch.zeros_like(frames.get(base.MASK))
            decides[torch.arange(len(slot), device=slot.device), slot] = True
            return frames.set(base.DECIDES, decides)
        found = TensorDict(batch_size=[len(env)], device=env.device)
        agents = TensorDict(batch_size=[len(env), 1], device=env.device)
        for name, leaf in steps.get("agents").items():
            agents.set(name, leaf[env, step, slot].unsqueeze(1))
        agents.set("decides", torch.ones_like(agents.get("mask")))
        return found.set("agents", agents)

    def _reward_sum(self, closed: TensorDictBase, following: TensorDictBase) -> Tensor:
        """Return the rewards ``[M, A, 1]`` of decisions; others in whole frames have none."""
        reward_sum = closed.get("reward_sum").float().view(-1, 1, 1)
        return torch.where(following.get(base.DECIDES).unsqueeze(-1), reward_sum, torch.zeros_like(reward_sum))

    def state_dict(self) -> dict[str, Any]:
        """Return the decisions that have not ended, as tensors by their keys joined with ``/``."""
        if self.open is None:
            return {}
        return {"/".join(key if isinstance(key, tuple) else (key,)): leaf for key, leaf in self.open.items(True, True)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        if not state:
            self.open = None
            return
        count = len(state["env"])
        found = TensorDict({"frame": TensorDict(batch_size=[count])}, [count])
        if "frame/agents/mask" in state:
            found.set(("frame", "agents"), TensorDict(batch_size=list(state["frame/agents/mask"].shape)))
        for name, leaf in state.items():
            found.set(tuple(name.split("/")), leaf)
        self.open = found


def shaped(batch: TensorDictBase, gamma: float) -> TensorDictBase:
    """Return a batch whose rewards are compared with the uncommanded episode's, by
    :data:`~izoo.algos.learners.base.POTENTIAL`.

    The potential of a vehicle is its reward-to-go at the same time of the uncommanded episode of the same context and
    seed. A reward becomes ``r + gamma * potential' - potential``, where a vehicle that has left has potential 0:
    potential-based shaping (Ng et al., ICML 1999). A return loses the potential at the time of its decision and nothing
    else, which no action of that vehicle changes; so the mean gradient is the same, and its variance falls by what the
    two episodes have in common: a control variate.

    Args:
        batch: ``[N, T]`` steps, or decisions, with potentials at the root and under ``"next"``.
        gamma: discount per entry.
    """
    following = batch.get(("next", *base.POTENTIAL))
    goes_on = ~batch.get(("next", *base.TERMINATED))
    change = gamma * torch.where(goes_on, following, torch.zeros_like(following)) - batch.get(base.POTENTIAL)
    return batch.copy().set(NEXT_REWARD, batch.get(NEXT_REWARD) + change)
