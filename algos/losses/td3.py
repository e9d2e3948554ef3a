"""The TD3 loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.objectives import TD3Loss

from izoo.algos.learners import base
from izoo.algos.losses.transitions import AgentKeys, OnTransitions


class MaskedTD3Loss(OnTransitions, TD3Loss):
    """TorchRL's TD3 loss over the valid transitions of ``[*B, A]``: targets from the lesser of several critics, at an
    action to which noise was added.

    It moves the actor whenever it is called; the delay is the caller's.

    Args:
        actor: deterministic; writes the batch's action.
        critic: reads observation and action of one agent, writes ``("agents", "state_action_value")``; a list of
            critics, or one, of which a second is made that begins elsewhere.
        bounds: of the action, in its unit.
        target_noise, target_noise_clip: spread of the noise on the target's action, and most of it, in half widths of
            the action's range (TorchRL's ``policy_noise`` and ``noise_clip`` are in the action's unit).
        loss_function: ``smooth_l1`` or ``l2``; the critics' losses are summed.
        gamma: discount of the default value estimator.
        options: further ones of TorchRL's ``TD3Loss``.
    """

    @dataclass
    class _AcceptedKeys(AgentKeys, TD3Loss._AcceptedKeys):
        action: NestedKey = base.ACTION

    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor: TensorDictModuleBase,
        critic: TensorDictModuleBase | Sequence[TensorDictModuleBase],
        *,
        bounds: tuple[float, float],
        target_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        loss_function: str = "smooth_l1",
        gamma: float = 0.99,
        **options: Any,
    ) -> None:
        low, high = (float(end) for end in bounds)
        half = (high - low) / 2
        critics = critic if isinstance(critic, TensorDictModuleBase) else list(critic)
        super().__init__(
            actor,
            critics,
            bounds=(low, high),  # type: ignore[arg-type]
            num_qvalue_nets=len(critics) if isinstance(critics, list) else 2,
            policy_noise=target_noise * half,
            noise_clip=target_noise_clip * half,
            loss_function=loss_function,
            **options,
        )
        self._estimate_by_td0(gamma)

    def _critic(self) -> TensorDictModuleBase:
        return self.qvalue_network
