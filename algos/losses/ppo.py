"""Clipped PPO losses: of agents alone, with a critic over the set of agents, and on graphs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Normal, kl_divergence
from torchrl.modules import ValueNorm
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from izoo.algos.learners import base
from izoo.algos.losses.masked_gae import MaskedGAE
from izoo.algos.networks.censored_normal import normal_of
from izoo.algos.networks.masking import (
    AROUND,
    check_finite,
    has_no_agents,
    is_set_module,
    no_losses,
    on_rows,
    rows_around,
    rows_of,
)
from izoo.algos.networks.set_networks import COLUMN, FRAME
from izoo.errors import IzooError


class MaskedPPOLoss(ClipPPOLoss):
    """TorchRL's clipped loss over the valid agent-steps of ``[*B, A]``.

    Advantages are estimated first where a batch does not hold them yet; it must then be ``[*B, T]``, consecutive in its
    last dimension (:class:`MaskedGAE`, :meth:`make_value_estimator`).

    Args:
        actor: ``ProbabilisticActor``; its action and log-probability are the batch's.
        critic: writes ``("agents", "state_value")``.
        clip_epsilon: bound on the change of the probability ratio.
        entropy_coeff: weight of the entropy bonus.
        critic_coeff: weight of the value loss.
        loss_critic_type: ``smooth_l1`` or ``l2``.
        value_error_clip: value errors above this give no gradient, as in RLlib; ``None`` for none.
        kl_coeff: weight of a penalty on the divergence from the policy that collected, as in RLlib, whose median and
            spread the batch must hold. (TorchRL's ``KLPENPPOLoss`` has it instead of the clipping.)
        normalize_advantage: over the valid rows of each call.
        value_norm: one of TorchRL's. The critic then learns value targets in the unit of their spread, and its outputs
            are denormalised where advantages are estimated; the running statistics are of valid agent-steps, and move
            with each estimate. (In TorchRL's ``MAPPOLoss`` the errors are scaled alone: the critic itself still has to
            reach values of any size.)
        gamma, lmbda: of the default value estimator.
        options: further ones of TorchRL's ``ClipPPOLoss``.
    """

    @dataclass
    class _AcceptedKeys(ClipPPOLoss._AcceptedKeys):
        advantage: NestedKey = base.ADVANTAGE
        value_target: NestedKey = base.VALUE_TARGET
        value: NestedKey = base.VALUE
        reward: NestedKey = base.REWARD
        done: NestedKey = base.DONE
        terminated: NestedKey = base.TERMINATED
        mask: NestedKey = base.MASK
        loc: NestedKey = base.LOC
        scale: NestedKey = base.SCALE

    default_keys = _AcceptedKeys
    team = False

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        critic: TensorDictModuleBase,
        *,
        clip_epsilon: float = 0.2,
        entropy_coeff: float = 0.0,
        critic_coeff: float = 0.5,
        loss_critic_type: str = "smooth_l1",
        value_error_clip: float | None = None,
        kl_coeff: float = 0.0,
        normalize_advantage: bool = False,
        value_norm: ValueNorm | None = None,
        gamma: float = 0.99,
        lmbda: float = 0.95,
        **options: Any,
    ) -> None:
        mask = self.default_keys().mask
        super().__init__(
            on_rows(actor, mask),
            on_rows(critic, mask),
            clip_epsilon=clip_epsilon,
            entropy_bonus=entropy_coeff > 0,
            entropy_coeff=entropy_coeff,
            critic_coeff=critic_coeff,
            loss_critic_type=loss_critic_type,
            normalize_advantage=normalize_advantage,
            **options,
        )
        self.value_norm = value_norm
        self._discounts = {"gamma": gamma, "lmbda": lmbda}
        self._most_value_loss = None if value_error_clip is None else critic_coeff * value_error_clip
        self._punishes_divergence = kl_coeff > 0
        self.register_buffer("kl_weight", torch.tensor(float(kl_coeff)))
        self._divergence: Tensor | None = None

    def make_value_estimator(self, value_type: ValueEstimators | None = None, **hyperparams: Any) -> MaskedPPOLoss:
        """Make the masked estimator of advantages; ``gamma`` and ``lmbda`` may be given."""
        if value_type not in (None, ValueEstimators.GAE):
            raise IzooError(f"the value estimator is {value_type}; masked batches have ValueEstimators.GAE alone.")
        keys = self.tensor_keys
        options = {
            **self._discounts,
            **hyperparams,
            "mask": keys.mask,
            "team": self.team,
            "value_norm": self.value_norm,
        }
        self.value_type = ValueEstimators.GAE
        self._value_estimator = MaskedGAE(value_network=self.critic_network, **options)
        self._forward_value_estimator_keys()
        return self

    def _forward_value_estimator_keys(self, **_: Any) -> None:
        if self._value_estimator is not None:
            keys = self.tensor_keys
            self._value_estimator.mask = keys.mask
            names = ("advantage", "value_target", "value", "reward", "done", "terminated")
            self._value_estimator.set_keys(**{name: getattr(keys, name) for name in names})

    def rows(self, batch: TensorDictBase) -> TensorDict:
        """Return the valid agent-steps ``[n]`` of a batch with advantages: what the loss is computed of."""
        keys = self.tensor_keys
        seen = [*self.actor_network.in_keys, *self.critic_network.in_keys]
        needed: Sequence[NestedKey] = [
            *seen,
            *(keys.action, keys.sample_log_prob, keys.advantage, keys.value_target),
            *((keys.loc, keys.scale) if self._punishes_divergence else ()),
        ]
        there, wanted = batch.get(keys.mask), base.deciding(batch, keys.mask)
        rows = rows_of(batch, wanted, needed)
        if FRAME in seen and base.DECIDES in batch.keys(True):
            alone = torch.arange(len(rows), device=rows.device)  # each row is a frame of its own
            rows.set(AROUND, rows_around(batch, there, wanted, seen)).set(FRAME, alone)
            rows.set(COLUMN, torch.zeros_like(alone))
        return rows

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses (scalars) of a batch ``[*B, A]``, or of rows ``[n]`` without a mask; 0 without agents."""
        rows, mask = tensordict, base.deciding(tensordict, self.tensor_keys.mask)
        if has_no_agents(tensordict, mask):
            return no_losses(self)
        if mask is not None:
            if tensordict.get(self.tensor_keys.advantage, None) is None:
                tensordict = self.value_estimator(tensordict.copy(), params=self._cached_critic_network_params_detached)
            rows = self.rows(tensordict)
        else:
            check_finite(rows.exclude(AROUND))
        return self.of_rows(rows)

    def of_rows(self, rows: TensorDictBase) -> TensorDictBase:
        """Return the losses of one or more rows as :meth:`rows` returns them, which is not checked."""
        losses = super().forward(rows)
        divergence, self._divergence = self._divergence, None  # its graph is the caller's now
        if divergence is not None:
            losses.set("kl", divergence.detach())
            losses.set("loss_kl", self.kl_weight * divergence)
        return losses

    def _log_weight(self, tensordict: TensorDictBase, *shapes: Any, **options: Any) -> Any:
        """Compare the policy with the one that collected: TorchRL's ratios, and the divergence where it is punished.

        TorchRL makes the policy's distribution here, and writes its median and spread over those of the rows. KL is
        that of the normals before the tanh, a bijection, which does not change it; of advice, before it is censored,
        which is no less. ``kl_approx``, which TorchRL logs, is estimated by ``r - 1 - log r`` of the ratios ``r``: for
        each row 0 or more, and far less noisy than ``-log r`` (http://joschu.net/blog/kl-approx.html).
        """
        keys = self.tensor_keys
        old = Normal(tensordict.get(keys.loc), tensordict.get(keys.scale)) if self._punishes_divergence else None
        compared = super()._log_weight(tensordict, *shapes, **options)
        if old is not None:
            self._divergence = kl_divergence(old, normal_of(compared[1])).sum(-1).mean()
        log_ratio, policy, _, *correction = compared
        return log_ratio, policy, torch.expm1(log_ratio.detach()) - log_ratio.detach(), *correction

    def _critic_loss_inputs(self, target_return: Tensor, state_value: Tensor, old_state_value: Tensor | None) -> Any:
        """Return what the value loss compares: TorchRL's hook for normalisation."""
        if self.value_norm is not None:
            target_return = self.value_norm.normalize(target_return)
        return target_return, state_value, old_state_value

    def loss_critic(self, tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        """Return the value loss per row; errors beyond ``value_error_clip`` are flat."""
        loss, *rest = super().loss_critic(tensordict)
        if self._most_value_loss is not None:
            loss = loss.clamp(max=self._most_value_loss)
        return (loss, *rest)


class MaskedMAPPOLoss(MaskedPPOLoss):
    """:class:`MaskedPPOLoss` whose critic sees all agents of a frame.

    Args:
        actor, critic: the critic must read the mask, or rows with their frames.
        team: estimate one advantage for the whole team from its reward (:class:`MaskedGAE`).
        options: of :class:`MaskedPPOLoss`.
    """

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        critic: TensorDictModuleBase,
        *,
        team: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(actor, critic, **options)
        self.team = team
        if not is_set_module(self.critic_network):
            raise IzooError(
                f"the critic reads {critic.in_keys}, so it sees one agent alone; let it also read ('agents', "
                "'mask'), or use MaskedPPOLoss."
            )


class MaskedGraphPPOLoss(MaskedPPOLoss):
    """:class:`MaskedPPOLoss` whose actor sees the other agents of its frame, as graph networks do; the critic may.

    Args:
        actor, critic: the actor must read the mask, or rows with their frames.
        options: of :class:`MaskedPPOLoss`.
    """

    def __init__(self, actor: ProbabilisticTensorDictSequential, critic: TensorDictModuleBase, **options: Any) -> None:
        super().__init__(actor, critic, **options)
        if not is_set_module(self.actor_network):
            raise IzooError(
                f"the actor reads {actor.in_keys}, so it sees one agent alone; let it also read ('agents', "
                "'mask'), or use MaskedPPOLoss."
            )
