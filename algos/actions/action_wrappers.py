"""Policies whose origin is doing nothing: what they emit is advice, and advice of 0 changes nothing.

To the algorithm, the advice *is* the action: it is what its networks emit, what it computes log-probabilities of, and
what its losses see. A :class:`Translator` makes commands of it for the environment.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from izoo.algos.actions.executed_actions import AppliedAcceleration
from izoo.algos.drivers.scripted import DEFER
from izoo.algos.learners import base
from izoo.algos.learners.imitation import EXPERT_ADVICE
from izoo.contexts.features import feature
from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.envs.mdp.observation import SPEED_SCALE_MPS
from izoo.errors import IzooError

ADVICE = ("agents", "advice")
MOST_IMITATED = 0.98
"""Advice is imitated up to this share of the deepest: the tanh reaches that nowhere."""
NOTICED_MPS2 = 0.05
"""A vehicle that accelerates less than commanded by no more than this does what it was told."""


class Translator(nn.Module):
    """Makes commands of advice.

    Attributes:
        two_sided: whether there are agents for whom advice below 0 means something.
    """

    two_sided = False

    def look(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, ...]:
        """Return what :meth:`command` needs, ``[*B, A]`` each; two-sided translators: secondly, who is guided.

        Args:
            observation: ``[*B, A, F]``.
            mask: ``[*B, A]``; what empty slots get does not matter.
        """
        raise NotImplementedError

    def command(self, seen: tuple[Tensor, ...], advice: Tensor) -> tuple[Tensor, Tensor]:
        """Return accelerations in m/s^2, and who is left to the simulator's driver, ``[*B, A]`` each.

        Args:
            seen: what :meth:`look` returned.
            advice: ``[*B, A]``.
        """
        raise NotImplementedError

    def advice_for(self, seen: tuple[Tensor, ...], accel: Tensor, defer: Tensor) -> Tensor:
        """Return the advice ``[*B, A]`` that comes closest to a command; the inverse of :meth:`command`.

        Args:
            seen: what :meth:`look` returned.
            accel: ``[*B, A]`` m/s^2.
            defer: ``[*B, A]`` bool: the command is to leave the vehicle alone.
        """
        raise NotImplementedError

    def carried_out(self, seen: tuple[Tensor, ...], advice: Tensor, applied: Tensor) -> Tensor:
        """Return the advice ``[*B, A]`` that stands for what came of ``advice``.

        Args:
            seen: what :meth:`look` returned.
            advice: ``[*B, A]``, without its band.
            applied: ``[*B, A]`` m/s^2, the acceleration that the vehicle had.
        """
        raise NotImplementedError


class SpeedCap(Translator):
    """Advice ``u`` in ``(0, 1)`` caps a vehicle's speed at ``(1 - u)`` times the limit; 0 and below do nothing.

    A vehicle that is faster brakes, within one decision or as hard as allowed, whichever is milder. Below the cap it
    accelerates no faster than to reach the cap at the end of the decision; the simulator keeps it to what its own
    driver would do, so a small ``u`` changes little. Advice is heard before the stop line alone: what is behind it
    does not count in the benefit of an approach, so that whoever searches for that would find ways to burn it there.

    Args:
        config: settings of the environment; the feature ``speed_limit_mps`` must be observed.
        brake_mps2: no advice brakes harder than this.
    """

    def __init__(self, config: EnvConfig, brake_mps2: float) -> None:
        super().__init__()
        names = observation_names(config)
        if "context_speed_limit_mps" not in names:
            raise IzooError(
                f"action=advise caps speeds relative to the limit, but env.observed is {list(config.observed)}; add "
                "speed_limit_mps."
            )
        self.speed, self.limit = names.index("speed"), names.index("context_speed_limit_mps")
        self.approaching = names.index("location_approaching")
        self.limit_scale = feature("speed_limit_mps").scale
        self.brake_mps2, self.decision_s = brake_mps2, config.decision_s

    def look(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, ...]:
        speed, limit = observation[..., self.speed] * SPEED_SCALE_MPS, observation[..., self.limit] * self.limit_scale
        return speed, limit, observation[..., self.approaching] > 0.5

    def command(self, seen: tuple[Tensor, ...], advice: Tensor) -> tuple[Tensor, Tensor]:
        speed, limit, heard = seen
        accel = ((1.0 - advice) * limit - speed) / self.decision_s
        return accel.clamp(-self.brake_mps2, ACTION_HIGH_MPS2), (advice <= 0.0) | ~heard

    def advice_for(self, seen: tuple[Tensor, ...], accel: Tensor, defer: Tensor) -> Tensor:
        speed, limit, heard = seen
        advice = 1.0 - (speed + accel * self.decision_s) / limit.clamp_min(1e-3)
        return torch.where(defer | ~heard, torch.zeros_like(advice), advice.clamp(0.0, 1.0))

    def carried_out(self, seen: tuple[Tensor, ...], advice: Tensor, applied: Tensor) -> Tensor:
        """Return the advice, and 0 where it changed nothing: where the vehicle accelerated less than it was told."""
        accel, defer = self.command(seen, advice)
        return torch.where(defer | (applied < accel - NOTICED_MPS2), torch.zeros_like(advice), advice)


class AdvisedPolicy(TensorDictModuleBase):
    """A learned policy's action becomes ``("agents", "advice")``, and what it stands for the action.

    Args:
        learned: writes ``("agents", "action")`` ``[*B, A, 1]``, and has a ``quiet_band``.
        translator: makes commands of it.
    """

    def __init__(self, learned: TensorDictModuleBase, translator: Translator) -> None:
        super().__init__()
        self.learned, self.translator = learned, translator
        self.in_keys = list(dict.fromkeys([*learned.in_keys, base.OBSERVATION, base.MASK]))
        self.out_keys = [*learned.out_keys, ADVICE, DEFER, *([base.GUIDED] if translator.two_sided else [])]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write advice and acceleration, ``[*B, A, 1]`` each, ``defer``, and what else the learned policy writes."""
        seen = self.translator.look(tensordict.get(base.OBSERVATION), tensordict.get(base.MASK))
        if self.translator.two_sided:
            tensordict.set(base.GUIDED, seen[1])
        advice = self.learned(tensordict).get(base.ACTION)
        tensordict.set(ADVICE, advice)
        acted = self.without_band(advice).squeeze(-1)
        accel, defer = self.translator.command(seen, acted)
        tensordict.set(DEFER, defer)
        return tensordict.set(base.ACTION, accel.clamp(ACTION_LOW_MPS2, ACTION_HIGH_MPS2).unsqueeze(-1))

    def without_band(self, advice: Tensor) -> Tensor:
        """Return advice, of any shape, less the band around 0 that counts as doing nothing."""
        band = float(self.learned.quiet_band)
        return advice.sign() * (advice.abs() - band).clamp_min(0.0) if band > 0.0 else advice


class Advised:
    """An algorithm whose actions are advice; see :class:`izoo.algos.learners.base.Algorithm`.

    Args:
        learned: the algorithm, built for advice.
        translator: makes commands of what its policy emits.
        depth: no advice is beyond this.
        expert: a driver for it to imitate; every batch is then handed on with the advice that it would have given.
        applied: reads what came of the commands; the algorithm then learns from that.
    """

    def __init__(
        self,
        learned: base.Algorithm,
        translator: Translator,
        depth: float,
        *,
        expert: TensorDictModuleBase | None = None,
        applied: AppliedAcceleration | None = None,
    ) -> None:
        self.learned, self.translator, self.depth = learned, translator, depth
        self.expert, self.applied = expert, applied
        self.policy = AdvisedPolicy(learned.policy, translator)
        own, looks = base.reads(learned), expert is not None or applied is not None
        self.reads: base.Keys | None = None if own is None or looks else (*own, ADVICE, DEFER, base.MASK)

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Hand the batch on with the advice in the place of the action; the batch itself stays as it is."""
        own = batch.copy()
        emitted = batch.get(ADVICE)
        own.set(base.ACTION, emitted if self.applied is None else self.carried_out(batch, self.applied(batch)))
        if self.expert is not None:
            own.set(EXPERT_ADVICE, self.expert_advice(batch))
        stats = self.learned.update(own, progress)
        mask = batch.get(base.MASK)
        if mask.any():
            stats["advice_abs"] = float(batch.get(ADVICE)[mask].abs().mean())
            stats["acting_share"] = float((~batch.get(DEFER)[mask]).float().mean())
        return stats

    def carried_out(self, batch: TensorDictBase, accel: Tensor) -> Tensor:
        """Return the advice that stands for accelerations ``[N, T, A, 1]`` of a batch, in the same shape."""
        seen = self.translator.look(batch.get(base.OBSERVATION), batch.get(base.MASK))
        advice = self.policy.without_band(batch.get(ADVICE)).squeeze(-1)
        done = self.translator.carried_out(seen, advice, accel.squeeze(-1)).unsqueeze(-1)
        # What was carried out as it was advised stays as the policy emitted it, the band around 0 included.
        return torch.where(done == advice.unsqueeze(-1), batch.get(ADVICE), done.clamp(-self.depth, self.depth))

    @torch.no_grad()
    def expert_advice(self, batch: TensorDictBase) -> Tensor:
        """Return what the expert would have advised in a batch ``[N, T]``, ``[N, T, A, 1]``."""
        assert self.expert is not None
        observation, mask = batch.get(base.OBSERVATION), batch.get(base.MASK)
        asked = TensorDict(batch_size=batch.batch_size, device=observation.device)
        commands = self.expert(asked.set(base.OBSERVATION, observation).set(base.MASK, mask))
        seen = self.translator.look(observation, mask)
        advice = self.translator.advice_for(seen, commands.get(base.ACTION).squeeze(-1), commands.get(DEFER))
        return advice.clamp(max=MOST_IMITATED * self.depth).unsqueeze(-1)

    def state_dict(self) -> dict[str, Any]:
        """Return the learned algorithm's state: a translator has none."""
        return self.learned.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.learned.load_state_dict(state)
