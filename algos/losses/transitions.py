"""What off-policy losses share: transitions of agents as rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.objectives import ValueEstimators

from izoo.algos.learners import base
from izoo.algos.networks.masking import has_no_agents, no_losses, path_of, rows_of


@dataclass
class AgentKeys:
    """The keys of agents; before the keys of TorchRL's loss among the bases, they take the place of its own."""

    state_action_value: NestedKey = base.ACTION_VALUE
    reward: NestedKey = base.REWARD
    done: NestedKey = base.DONE
    terminated: NestedKey = base.TERMINATED
    mask: NestedKey = base.MASK


class OnTransitions:
    """What off-policy losses share: transitions ``[*B, A]`` in, their valid rows into TorchRL's own loss.

    Mixed in before a loss whose ``tensor_keys`` have ``mask``.
    """

    tensor_keys: Any
    actor_network: TensorDictModuleBase

    def _estimate_by_td0(self: Any, gamma: float) -> None:
        """Set the keys of the agents where TorchRL reads them, and the estimator of targets."""
        self.set_keys(**{name: getattr(self.default_keys(), name) for name in ("reward", "done", "terminated")})
        self.make_value_estimator(ValueEstimators.TD0, gamma=gamma)

    def _critic(self) -> TensorDictModuleBase:
        """Return the network of action values."""
        raise NotImplementedError

    def rows(self, batch: TensorDictBase) -> TensorDict:
        """Return the valid transitions ``[n]`` of a batch; vehicles that have left observe 0 afterwards."""
        keys = self.tensor_keys
        mask = base.deciding(batch, keys.mask)
        own = dict.fromkeys([*self.actor_network.in_keys, *self._critic().in_keys])
        after = [
            ("next", *path_of(key)) for key in (*self.actor_network.in_keys, keys.reward, keys.done, keys.terminated)
        ]
        gone = batch.get(("next", *path_of(keys.terminated)))
        cleared = batch.copy()
        for key in after[: len(self.actor_network.in_keys)]:
            leaf = batch.get(key)
            cleared.set(key, torch.where(gone, torch.zeros_like(leaf), leaf))
        return rows_of(cleared, mask, [*own, *after])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses (scalars) of a batch ``[*B, A]``, or of rows ``[n]`` without a mask; 0 without agents.

        The transitions' errors are written to the key ``priority``: ``[*B, A]`` with 0 in empty slots, or ``[n]``.
        """
        plain = super().forward  # type: ignore[misc]
        mask = base.deciding(tensordict, self.tensor_keys.mask)
        if has_no_agents(tensordict, mask):
            reward = tensordict.get(("next", *path_of(self.tensor_keys.reward)))
            tensordict.set(self.tensor_keys.priority, torch.zeros_like(reward[..., 0]))
            return no_losses(self)
        if mask is None:
            return plain(tensordict)
        rows = self.rows(tensordict)
        losses = plain(rows)
        error = rows.get(self.tensor_keys.priority)
        spread = torch.zeros(mask.shape, dtype=error.dtype, device=error.device)
        tensordict.set(self.tensor_keys.priority, spread.masked_scatter(mask, error.detach()))
        return losses
