"""The DDPG loss."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.objectives import DDPGLoss

from izoo.algos.losses.transitions import AgentKeys, OnTransitions


class MaskedDDPGLoss(OnTransitions, DDPGLoss):
    """TorchRL's DDPG loss over the valid transitions of ``[*B, A]``: TD(0) targets from target copies of the networks.

    Args:
        actor: deterministic; writes the batch's action.
        critic: reads observation and action of one agent; writes ``("agents", "state_action_value")``.
        loss_function: ``smooth_l1`` or ``l2``.
        gamma: discount of the default value estimator.
        options: further ones of TorchRL's ``DDPGLoss``.
    """

    @dataclass
    class _AcceptedKeys(AgentKeys, DDPGLoss._AcceptedKeys):
        pass

    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor: TensorDictModuleBase,
        critic: TensorDictModuleBase,
        *,
        loss_function: str = "smooth_l1",
        gamma: float = 0.99,
        **options: Any,
    ) -> None:
        delays = {"delay_actor": True, "delay_value": True}
        super().__init__(actor, critic, loss_function=loss_function, **{**delays, **options})
        self._estimate_by_td0(gamma)

    def _critic(self) -> TensorDictModuleBase:
        return self.value_network
