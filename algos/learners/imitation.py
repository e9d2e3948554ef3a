"""Learning that begins by imitating a scripted driver, on the states that the learner itself comes to.

For the first ``algo.warm_start_frames`` frames the policy drives, and learns the actions that the expert would have
chosen in every step (the queries of dataset aggregation, arXiv 1011.0686, without the aggregation); the value function
learns already. Then reinforcement learning goes on from there, with a penalty on the divergence from the imitation at
its end that fades to 0 over the rest of the run.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torch.distributions import kl_divergence

from izoo.algos.networks.censored_normal import normal_of

EXPERT_ACTION = ("agents", "expert_action")
"""``[*B, A, 1]``: the raw action that the expert would have chosen."""
LEAST_SPREAD = 0.1
"""Imitation narrows the policy no further than this, before the tanh: reinforcement goes on from its exploration."""


class WarmStart:
    """How far the warm start of a policy is, and the losses that it adds.

    Args:
        frames: how long the policy imitates; 0: not at all.
        kl_to_start: weight of the penalty at the end of the imitation.
    """

    def __init__(self, frames: int, kl_to_start: float) -> None:
        self.frames, self.kl_to_start = frames, kl_to_start
        self.seen = 0
        self.ended_at = 0.0
        self.start: TensorDict | None = None

    @property
    def imitating(self) -> bool:
        """Whether the policy still imitates."""
        return self.seen < self.frames

    @property
    def active(self) -> bool:
        """Whether it changes the losses."""
        return self.imitating or (self.start is not None and self.kl_to_start > 0.0)

    def losses(self, actor: Any, rows: TensorDictBase, found: TensorDictBase, progress: float) -> TensorDictBase:
        """Return the losses to learn from where :attr:`active`: the imitation's for the objective, or the penalty too.

        Args:
            actor: the loss's actor.
            rows: ``[n]`` a minibatch; it holds :data:`EXPERT_ACTION` while the policy imitates.
            found: the losses of reinforcement.
            progress: share of the run that is over.
        """
        if self.imitating:
            imitation = found.exclude("loss_objective", "loss_entropy", "loss_kl")
            return imitation.set("loss_imitation", imitation_loss(actor, rows))
        weight = self.kl_to_start * (1.0 - progress) / max(1.0 - self.ended_at, 1e-6)
        divergence = self._divergence(actor, rows)
        found.set("kl_to_start", divergence.detach())
        return found.set("loss_kl_to_start", weight * divergence)

    def count(self, frames: int, actor: Any, progress: float) -> None:
        """Count a batch that has been learned from.

        Args:
            frames: of the batch.
            actor: whose parameters are kept where the imitation ends.
            progress: share of the run that was over before the batch.
        """
        before, self.seen = self.imitating, self.seen + frames
        if before and not self.imitating:
            self.ended_at = progress
            self.start = _parameters(actor)

    def _divergence(self, actor: Any, rows: TensorDictBase) -> Tensor:
        """Return the mean KL(imitation || policy) of the normals before they are censored, which is no less."""
        assert self.start is not None
        inputs = rows.select(*actor.in_keys)
        with torch.no_grad(), self.start.to_module(actor):
            old = normal_of(actor.get_dist(inputs.copy()))
        return kl_divergence(old, normal_of(actor.get_dist(inputs))).mean()

    def state_dict(self) -> dict[str, Any]:
        """Return how far it is, and the imitation at its end."""
        start = None if self.start is None else self.start.to_dict()
        return {"seen": self.seen, "ended_at": self.ended_at, "start": start}

    def load_state_dict(self, state: dict[str, Any], actor: Any) -> None:
        """Restore what :meth:`state_dict` returned.

        Args:
            state: that.
            actor: for the structure of its parameters.
        """
        self.seen, self.ended_at = int(state["seen"]), float(state["ended_at"])
        self.start = None
        if state["start"] is not None:
            start = TensorDict.from_dict(state["start"], auto_batch_size=False)
            self.start = _parameters(actor).update_(start)


def _parameters(actor: Any) -> TensorDict:
    """Return a copy of a module's parameters, by their place in it."""
    return TensorDict.from_module(actor).detach().clone()


def imitation_loss(actor: ProbabilisticTensorDictSequential, rows: TensorDictBase) -> Tensor:
    """Return minus the mean log-likelihood of the expert's raw actions ``[n, 1]``, point mass included."""
    distribution: Any = actor.get_dist(rows.select(*actor.in_keys))
    own = distribution.base_dist
    own.scale = own.scale.clamp_min(LEAST_SPREAD)
    return -distribution.log_prob(rows.get(EXPERT_ACTION)).mean()
