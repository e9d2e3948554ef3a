"""Policies whose raw action is transformed into a command, and learning from what was executed.

To the algorithm, the raw action *is* the action: its networks emit it, its log-probabilities and losses are of it. An
:class:`ActionTransform` turns it into a command for the environment: a cap on the speed (:class:`SpeedCap`), a
correction of glide (:mod:`izoo.algos.actions.residual`), or speeds that arrive in time
(:mod:`izoo.algos.actions.arrival`).
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from izoo.algos.drivers.base import DEFER
from izoo.algos.drivers.observed import Observed
from izoo.algos.learners import base
from izoo.algos.learners.imitation import EXPERT_ACTION
from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, EnvConfig

RAW_ACTION = ("agents", "raw_action")
"""``[*B, A, D]``: the learned policy's action before it is transformed."""
MAX_IMITATED = 0.98
"""Raw actions are imitated up to this share of their bound, which tanh never reaches."""
NOTICED_MPS2 = 0.05
"""A vehicle whose acceleration is less than the command by no more than this has followed it."""


class ActionTransform(nn.Module):
    """Turns raw actions into commands. Raw actions of one number are ``[*B, A]`` here, of ``D`` numbers ``[*B, A, D]``.

    Attributes:
        defers: whether it says which vehicles are left to the simulator's driver.
        two_sided: whether there are agents whose raw actions below 0 differ from 0.
    """

    defers, two_sided = True, False

    def look(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, ...]:
        """Return what :meth:`command` needs; of two-sided transforms the second is which agents are, ``[*B, A]``.

        Args:
            observation: ``[*B, A, F]``.
            mask: ``[*B, A]``; results in empty slots do not matter.
        """
        raise NotImplementedError

    def command(self, seen: tuple[Tensor, ...], raw: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return the environment's actions, in the shape of ``raw``, and which vehicles are left to the simulator's
        driver, ``[*B, A]``; ``None`` without :attr:`defers`.

        Args:
            seen: what :meth:`look` returned.
            raw: the raw actions, without their band.
        """
        raise NotImplementedError

    def raw_action_for(self, seen: tuple[Tensor, ...], accel: Tensor, defer: Tensor) -> Tensor:
        """Return the raw action ``[*B, A]`` that comes closest to a command; the inverse of :meth:`command`.

        Args:
            seen: what :meth:`look` returned.
            accel: ``[*B, A]`` m/s^2.
            defer: ``[*B, A]`` bool: the command is to leave the vehicle alone.
        """
        raise NotImplementedError

    def carried_out(self, seen: tuple[Tensor, ...], raw: Tensor, executed: Tensor) -> Tensor:
        """Return the raw action ``[*B, A]`` that an executed acceleration corresponds to.

        Args:
            seen: what :meth:`look` returned.
            raw: ``[*B, A]``, without its band.
            executed: ``[*B, A]`` m/s^2, the acceleration that the vehicle had.
        """
        raise NotImplementedError


class SpeedCap(ActionTransform):
    """A raw action ``u`` in ``(0, 1)`` caps a vehicle's speed at ``(1 - u)`` times the limit; 0 and below do nothing.

    A faster vehicle brakes within one decision or as hard as allowed, whichever is milder. Below the cap it accelerates
    no faster than to reach the cap at the end of the decision; the simulator bounds that by its own driver's
    acceleration, so a small ``u`` changes little. It acts before the stop line only: driving behind the line does not
    count in the benefit of an approach, so a search for that benefit would burn fuel there.

    Args:
        config: settings of the environment; the feature ``speed_limit_mps`` must be observed.
        brake_mps2: bound on the braking.
    """

    def __init__(self, config: EnvConfig, brake_mps2: float) -> None:
        super().__init__()
        self.seen = Observed(config, ("context_speed_limit_mps",), "action=advise")
        self.brake_mps2, self.decision_s = brake_mps2, config.decision_s

    def look(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, ...]:
        speed, limit = (self.seen(observation, name) for name in ("speed", "context_speed_limit_mps"))
        return speed, limit, self.seen.flag(observation, "location_approaching")

    def command(self, seen: tuple[Tensor, ...], raw: Tensor) -> tuple[Tensor, Tensor]:
        speed, limit, approaching = seen
        accel = ((1.0 - raw) * limit - speed) / self.decision_s
        return accel.clamp(-self.brake_mps2, ACTION_HIGH_MPS2), (raw <= 0.0) | ~approaching

    def raw_action_for(self, seen: tuple[Tensor, ...], accel: Tensor, defer: Tensor) -> Tensor:
        speed, limit, approaching = seen
        raw = 1.0 - (speed + accel * self.decision_s) / limit.clamp_min(1e-3)
        return torch.where(defer | ~approaching, torch.zeros_like(raw), raw.clamp(0.0, 1.0))

    def carried_out(self, seen: tuple[Tensor, ...], raw: Tensor, executed: Tensor) -> Tensor:
        """Return the raw action, or 0 where it changed nothing: the vehicle accelerated less than commanded."""
        accel, defer = self.command(seen, raw)
        return torch.where(defer | (executed < accel - NOTICED_MPS2), torch.zeros_like(raw), raw)


class TransformedPolicy(TensorDictModuleBase):
    """A learned policy whose action becomes :data:`RAW_ACTION`; the action is the command that follows from it.

    Args:
        learned: writes ``("agents", "action")`` ``[*B, A, D]``; its ``no_op_band`` around 0, if any, counts as 0.
        transform: turns its actions into commands.
    """

    def __init__(self, learned: TensorDictModuleBase, transform: ActionTransform) -> None:
        super().__init__()
        self.learned, self.transform = learned, transform
        self.in_keys = list(dict.fromkeys([*learned.in_keys, base.OBSERVATION, base.MASK]))
        self.out_keys = [*learned.out_keys, RAW_ACTION]
        self.out_keys += [*([DEFER] if transform.defers else []), *([base.TWO_SIDED] if transform.two_sided else [])]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write raw action and action, ``defer`` where the transform has it, and the learned policy's outputs."""
        mask = tensordict.get(base.MASK)
        seen = self.transform.look(tensordict.get(base.OBSERVATION), mask)
        if self.transform.two_sided:
            tensordict.set(base.TWO_SIDED, seen[1])
        raw = self.learned(tensordict).get(base.ACTION)
        action, defer = self.transform.command(seen, self.without_band(raw).squeeze(-1))
        if defer is not None:
            tensordict.set(DEFER, defer)
        return tensordict.set(RAW_ACTION, raw).set(base.ACTION, action.reshape(raw.shape))

    def without_band(self, raw: Tensor) -> Tensor:
        """Return raw actions, of any shape, less the band around 0 that counts as 0."""
        band = float(getattr(self.learned, "no_op_band", 0.0))
        return raw.sign() * (raw.abs() - band).clamp_min(0.0) if band > 0.0 else raw


class TransformedAlgorithm(base.AlgorithmWrapper):
    """An algorithm whose actions are transformed; see :class:`izoo.algos.learners.base.Algorithm`.

    Args:
        learned: the algorithm, built for raw actions.
        transform: turns its actions into commands.
        bound: raw actions lie between plus and minus this.
        expert: a driver to imitate; every batch then also holds the raw actions that it would have chosen.
        executed: reads executed accelerations; the algorithm then learns from those.
    """

    policy: TransformedPolicy

    def __init__(
        self,
        learned: base.Algorithm,
        transform: ActionTransform,
        bound: float,
        *,
        expert: TensorDictModuleBase | None = None,
        executed: ExecutedAcceleration | None = None,
    ) -> None:
        super().__init__(learned, TransformedPolicy(learned.policy, transform))
        self.transform, self.bound = transform, bound
        self.expert, self.executed = expert, executed
        own, looks = base.reads(learned), expert is not None or executed is not None
        also = (RAW_ACTION, base.MASK, *([DEFER] if transform.defers else []))
        self.reads: base.Keys | None = None if own is None or looks else (*own, *also)

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Learn from the batch with the raw action as its action; the batch itself is not changed."""
        own = batch.copy()
        emitted = batch.get(RAW_ACTION)
        own.set(base.ACTION, emitted if self.executed is None else self.carried_out(batch, self.executed(batch)))
        if self.expert is not None:
            own.set(EXPERT_ACTION, self.expert_action(batch))
        stats = self.learned.update(own, progress)
        mask, defer = batch.get(base.MASK), batch.get(DEFER, None)
        if defer is not None and mask.any():
            stats["raw_action_abs"] = float(emitted[mask].abs().mean())
            stats["acting_share"] = float((~defer[mask]).float().mean())
        return stats

    def carried_out(self, batch: TensorDictBase, accel: Tensor) -> Tensor:
        """Return the raw actions that executed accelerations ``[N, T, A, 1]`` correspond to, in the same shape."""
        seen = self.transform.look(batch.get(base.OBSERVATION), batch.get(base.MASK))
        raw = self.policy.without_band(batch.get(RAW_ACTION)).squeeze(-1)
        done = self.transform.carried_out(seen, raw, accel.squeeze(-1)).unsqueeze(-1)
        # What was carried out as commanded stays as the policy emitted it, the band around 0 included.
        return torch.where(done == raw.unsqueeze(-1), batch.get(RAW_ACTION), done.clamp(-self.bound, self.bound))

    @torch.no_grad()
    def expert_action(self, batch: TensorDictBase) -> Tensor:
        """Return the raw actions that the expert would have chosen in a batch ``[N, T]``, ``[N, T, A, 1]``."""
        assert self.expert is not None
        observation, mask = batch.get(base.OBSERVATION), batch.get(base.MASK)
        asked = TensorDict(batch_size=batch.batch_size, device=observation.device)
        commands = self.expert(asked.set(base.OBSERVATION, observation).set(base.MASK, mask))
        seen = self.transform.look(observation, mask)
        raw = self.transform.raw_action_for(seen, commands.get(base.ACTION).squeeze(-1), commands.get(DEFER))
        return raw.clamp(max=MAX_IMITATED * self.bound).unsqueeze(-1)


class ExecutedAcceleration:
    """Reads accelerations that were executed from the speeds that were observed before and after.

    The simulator's own driver may brake harder than a command asks. All commands above that are then equivalent, which
    a critic that sees the commands would have to learn.

    Args:
        config: settings of the environment.
    """

    def __init__(self, config: EnvConfig) -> None:
        self.place, scale_mps = Observed(config).columns["speed"]
        self.scale_mps2 = scale_mps / config.decision_s

    def __call__(self, batch: TensorDictBase) -> Tensor:
        """Return the mean acceleration over each decision of a batch ``[N, T]``, ``[N, T, A, 1]`` m/s^2.

        It is the command where the next speed is unknown, because the vehicle has left, and in the last decision of an
        episode, which may be shorter than the others.
        """
        before, after = (part.get(base.OBSERVATION)[..., self.place] for part in (batch, batch.get("next")))
        accel = ((after - before) * self.scale_mps2).clamp(ACTION_LOW_MPS2, ACTION_HIGH_MPS2).unsqueeze(-1)
        after_mask, done = (batch.get(("next", *key)) for key in (base.MASK, base.DONE))
        known = batch.get(base.MASK) & after_mask & ~done.squeeze(-1)
        return torch.where(known.unsqueeze(-1), accel, batch.get(base.ACTION))


class ExecutedActions(base.AlgorithmWrapper):
    """An algorithm that commands accelerations and learns from those that were executed.

    Args:
        learned: the algorithm; see :class:`izoo.algos.learners.base.Algorithm`.
        executed: reads them.
    """

    def __init__(self, learned: base.Algorithm, executed: ExecutedAcceleration) -> None:
        super().__init__(learned)
        self.executed = executed

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Learn from the batch with executed accelerations as its actions; the batch itself is not changed."""
        return self.learned.update(batch.copy().set(base.ACTION, self.executed(batch)), progress)
