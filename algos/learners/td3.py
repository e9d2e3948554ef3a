"""TD3 (Fujimoto et al., arXiv 1802.09477): DDPG with three changes.

There are two critics, of which the lesser counts; noise is added to the target's action; and the actor moves less often
than the critics. Everything else, replay and exploration included, is :mod:`izoo.algos.learners.ddpg`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from izoo.algos.learners.ddpg import DDPG, DDPGConfig
from izoo.algos.losses import MaskedTD3Loss


@dataclass(frozen=True)
class TD3Config(DDPGConfig):
    """Hyper-parameters of TD3: those of DDPG, and of its three changes.

    The paper has no TD3, so there is no preset ``paper``.

    Attributes:
        name: the algorithm.
        policy_delay: gradient steps of the critics for each one of the actor and of the target networks (TD3 2; ours
            the same).
        target_noise: spread of the noise on the target network's action, in half widths of the action's range (TD3
            0.2; ours the same).
        target_noise_clip: most of that noise (TD3 0.5; ours the same).
    """

    name: str = "td3"
    stores: Literal["commanded", "applied"] = "applied"
    policy_delay: int = 2
    target_noise: float = 0.2
    target_noise_clip: float = 0.5
    ranges = (("policy_delay", 1, 10**6), ("target_noise target_noise_clip", 0.0, 10.0))


class TD3(DDPG):
    """DDPG with the three changes; the arguments are the same."""

    options = TD3Config
    config: TD3Config
    critic_name = "qvalue"

    def make_loss(self, features: int) -> MaskedTD3Loss:
        """Return the loss of ``actor`` and two critics of its own."""
        config = self.config
        return MaskedTD3Loss(
            self.actor,
            [self.make_critic(features) for _ in range(2)],
            bounds=(self.space.low, self.space.high),
            target_noise=config.target_noise,
            target_noise_clip=config.target_noise_clip,
            loss_function=config.value_loss,
            gamma=config.gamma,
        )

    @property
    def policy_delay(self) -> int:
        """Gradient steps of the critics for each one of the actor and of the target networks."""
        return self.config.policy_delay

    def state_dict(self) -> dict[str, Any]:
        """Return what DDPG does, and how many gradient steps were made."""
        return {**super().state_dict(), "gradient_steps": self.gradient_steps}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        super().load_state_dict(state)
        self.gradient_steps = int(state["gradient_steps"])
