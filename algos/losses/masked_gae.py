"""Generalised advantage estimation for agents that come and go, as a TorchRL value estimator."""

from __future__ import annotations

import contextlib
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.modules import ValueNorm
from torchrl.objectives.value import GAE
from torchrl.objectives.value.functional import generalized_advantage_estimate

from izoo.algos.learners import base
from izoo.algos.networks.masking import InFrames, OnRows, check_finite, is_set_module, on_rows, path_of, rows_of
from izoo.algos.networks.set_networks import FRAMES_AT_ONCE
from izoo.errors import IzooError

TEAM_REWARD = "team_reward"
ROWS_AT_ONCE = 4096
"""Most rows that go through a network at once where no gradient is needed: what fits into a cache is faster."""


class MaskedGAE(GAE):
    """Generalised advantage estimation per agent slot, for agents that come and go.

    A slot's next state is what it holds one step later until its agent is ``done``; nothing passes through empty slots.
    Empty slots get advantage and value target 0.

    With ``team`` the whole team is one agent, as in TorchRL's ``MultiAgentGAE`` with its shared rewards: one value per
    frame, ``("next", team_reward)`` and the root's done; the valid agents of a frame share its advantage. TorchRL's own
    broadcasts the team's reward over fixed agents, and so takes an agent's leaving for the end of the team's return.

    Args:
        gamma, lmbda: discount and trace decay per entry of the time dimension.
        value_network: on rows, or reading the mask.
        mask: key of the mask.
        team: see above; the value network must then write ``[*M, 1]`` for frames.
        team_reward: key of the team's reward ``[*B, T, 1]`` under ``"next"``.
        value_norm: of networks whose values are normalised: estimates are made of what it turns them back into, and it
            then learns from the value targets of the valid agent-steps (of the team: of all frames).
        options: of TorchRL's ``GAE``.
    """

    def __init__(
        self,
        *,
        gamma: float,
        lmbda: float,
        value_network: TensorDictModuleBase,
        mask: NestedKey = base.MASK,
        team: bool = False,
        team_reward: NestedKey = TEAM_REWARD,
        value_norm: ValueNorm | None = None,
        **options: Any,
    ) -> None:
        super().__init__(gamma=gamma, lmbda=lmbda, value_network=on_rows(value_network, mask), **options)
        self.mask, self.team, self.team_reward = mask, team, team_reward
        self.value_norm = value_norm
        self.set_keys(
            advantage=base.ADVANTAGE,
            value_target=base.VALUE_TARGET,
            value=base.VALUE,
            reward=base.REWARD,
            done=base.DONE,
            terminated=base.TERMINATED,
        )

    @torch.no_grad()
    def forward(
        self, tensordict: TensorDictBase, *, params: Any = None, target_params: Any = None, time_dim: int | None = None
    ) -> TensorDictBase:
        """Write advantages and value targets ``[*B, T, A, 1]`` into ``tensordict`` ``[*B, T]``."""
        batch = tensordict.reshape(-1, tensordict.shape[-1]) if tensordict.ndim != 2 else tensordict
        network = contextlib.nullcontext() if params is None else params.to_module(self.value_network)
        with network:
            estimate = self._team(batch) if self.team else self._slots(batch)
        shape = tensordict.shape
        for key, value in zip((self.tensor_keys.advantage, self.tensor_keys.value_target), estimate, strict=True):
            tensordict.set(key, value.reshape(*shape, *value.shape[2:]))
        return tensordict

    def _slots(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        keys = self.tensor_keys
        names = (keys.done, keys.terminated, keys.reward)
        done, terminated, reward = (batch.get(("next", *path_of(key))) for key in names)
        mask = self._mask(batch, reward)
        reward = torch.where(mask.unsqueeze(-1), reward, torch.zeros_like(reward))
        check_finite(TensorDict({keys.reward: reward[mask]}, [int(mask.sum())]), mask)
        value = torch.zeros_like(reward)
        value[mask] = self.values(batch, mask)
        boundary = mask & done.squeeze(-1)
        boundary[:, -1] = mask[:, -1]
        goes_on = boundary & ~terminated.squeeze(-1)
        bootstrap = torch.zeros_like(value)
        bootstrap[goes_on] = self.values(batch.get("next"), goes_on)
        following = base.next_values(value, boundary, bootstrap[boundary])
        advantage, target = generalized_advantage_estimate(
            self.gamma, self.lmbda, value, following, reward, done, terminated, time_dim=1
        )
        self._learn_scale(target[mask])
        return _valid(advantage, mask), _valid(target, mask)

    def _team(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        reward = batch.get(("next", *path_of(self.team_reward)), None)
        if reward is None:
            raise IzooError(
                f"('next', {self.team_reward!r}) is missing, which the team's advantages are estimated from; let the "
                "environment emit it: env.emit=[team_reward]."
            )
        done, terminated = batch.get(("next", "done")), batch.get(("next", "terminated"))
        mask = self._mask(batch, batch.get(("next", *path_of(self.tensor_keys.reward))))
        value = self.team_values(batch, torch.ones(batch.shape, dtype=torch.bool, device=mask.device))
        boundary = done.squeeze(-1).clone()
        boundary[:, -1] = True
        following = torch.zeros_like(value)
        following[:, :-1] = value[:, 1:]
        following[boundary] = self.team_values(batch.get("next"), boundary)[boundary]
        advantage, target = generalized_advantage_estimate(
            self.gamma, self.lmbda, value, following, reward, done, terminated, time_dim=1
        )
        self._learn_scale(target.reshape(-1, 1))
        return _valid(advantage.unsqueeze(2), mask), _valid(target.unsqueeze(2), mask)

    def _learn_scale(self, targets: Tensor) -> None:
        """Let the normalisation follow value targets ``[n, 1]``."""
        if self.value_norm is not None and len(targets) > 0:
            self.value_norm.update(targets)

    def _true(self, values: Tensor) -> Tensor:
        """Return values of the network in the unit of the rewards."""
        return values if self.value_norm is None else self.value_norm.denormalize(values)

    def _mask(self, batch: TensorDictBase, template: Tensor) -> Tensor:
        mask = base.deciding(batch, self.mask)
        return torch.ones(template.shape[:-1], dtype=torch.bool, device=template.device) if mask is None else mask

    def values(self, frames: TensorDictBase, wanted: Tensor) -> Tensor:
        """Return the values ``[wanted.sum(), 1]`` of the agents ``wanted`` ``[N, T, A]`` of ``frames`` ``[N, T]``."""
        network, key = self.value_network, self.tensor_keys.value
        parts = [wanted.new_zeros((0, 1), dtype=torch.float32)]
        if not is_set_module(network):
            rows = rows_of(frames, wanted, network.in_keys)
            begins = range(0, len(rows), ROWS_AT_ONCE)
            parts += [network(rows[begin : begin + ROWS_AT_ONCE]).get(key) for begin in begins]
            return self._true(torch.cat(parts))
        some = wanted.any(-1)
        # All agents of a frame are needed, whichever are wanted.
        all_agents = frames.get(self.mask)[some] | wanted[some]
        chosen, wanted, origin = frames[some], wanted[some], some.nonzero()
        for begin in range(0, len(chosen), FRAMES_AT_ONCE):
            part = slice(begin, begin + FRAMES_AT_ONCE)
            rows = rows_of(chosen[part], all_agents[part], network.in_keys, origin[part])
            parts.append(network(rows).get(key)[wanted[part][all_agents[part]]])
        return self._true(torch.cat(parts))

    def team_values(self, frames: TensorDictBase, wanted: Tensor) -> Tensor:
        """Return one value per frame, ``[N, T, 1]``, where ``wanted`` ``[N, T]``, 0 elsewhere."""
        network = self.value_network
        network = network.module if isinstance(network, InFrames) else network
        if not isinstance(network, OnRows):
            raise IzooError(
                "the team's value needs a critic that reads the mask and writes one value per frame, [*M, 1]."
            )
        chosen = frames[wanted]
        found = []
        for begin in range(0, len(chosen), FRAMES_AT_ONCE):
            part = chosen[begin : begin + FRAMES_AT_ONCE]
            # Its leaves alone, since the group of the agents has a dimension more than the team's value.
            seen = TensorDict(batch_size=[len(part)], device=part.device)
            for source in network.module.in_keys:
                seen.set(source, part.get(source))
            found.append(network.module(seen).get(self.tensor_keys.value))
        values = torch.zeros(*wanted.shape, 1, device=wanted.device)
        return values.masked_scatter(wanted.unsqueeze(-1), self._true(torch.cat(found))) if found else values


def _valid(values: Tensor, mask: Tensor) -> Tensor:
    """Return ``values`` ``[N, T, A or 1, 1]`` where ``mask`` ``[N, T, A]`` is true, 0 elsewhere."""
    return torch.where(mask.unsqueeze(-1), values, torch.zeros_like(values))
