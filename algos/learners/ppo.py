"""Proximal policy optimisation for interchangeable agents: one policy and one value function, shared by every CV.

Each agent-step is an independent sample (IPPO with shared parameters). Advantages are estimated per agent slot on the
batch ``[N, T]``; then the valid entries are flattened, once for all minibatches (:mod:`izoo.algos.losses`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.modules import PopArtValueNorm, ProbabilisticActor, RunningValueNorm, ValueNorm, ValueOperator

from izoo.algos.actions.action_modes import PointMass
from izoo.algos.learners import base
from izoo.algos.learners.imitation import EXPERT_ACTION, WarmStart
from izoo.algos.learners.ppo_config import PPOConfig
from izoo.algos.losses import MaskedPPOLoss
from izoo.algos.losses.masked_gae import TEAM_REWARD
from izoo.algos.networks.gaussian import CompiledPolicy, SamplingPolicy, normal_parameters, tanh_normal

POPART_BETA = 0.99
"""What is left of a batch's weight in the statistics one batch later."""


def make_actor(
    features: int, low: float, high: float, config: PPOConfig, point_mass: PointMass | None = None, size: int = 1
) -> ProbabilisticActor:
    """Return the policy: a tanh-squashed normal over actions ``[low, high]^size``; with ``point_mass``, a censored one.

    It works on the last dimension of ``("agents", "observation")``, for any number of agents or flat rows.
    """
    network = base.mlp(features, config.hidden, 2 * size, config.activation, 0.01, config.standardise)
    extract = normal_parameters(network[-1], low, high, config.initial_accel_mps2, config.initial_spread, point_mass)  # type: ignore[arg-type]
    return tanh_normal(nn.Sequential(network, extract), [base.OBSERVATION], low, high, point_mass)


def make_value_norm(name: str) -> ValueNorm | None:
    """Return the normalisation of value targets that the option ``algo.value_norm`` names."""
    if name == "none":
        return None
    return RunningValueNorm() if name == "running" else PopArtValueNorm(beta=POPART_BETA)


def make_critic(features: int, config: PPOConfig) -> ValueOperator:
    """Return the value function of one agent's own observation."""
    network = base.mlp(features, config.hidden, 1, config.activation, 1.0, config.standardise)
    return ValueOperator(network, in_keys=[base.OBSERVATION], out_keys=[base.VALUE])


class PPO:
    """The algorithm: policy, value function, optimiser and update.

    Args:
        config: hyper-parameters.
        features: length ``F`` of an observation.
        low, high: bounds of the action: of an acceleration in m/s^2, a share of the speed limit, or a raw action.
        device: where the networks live.
        point_mass: at the action 0, which leaves a vehicle alone; ``None``: there is none.
        size: numbers of an action.

    Attributes:
        advantage: ``[N, T, A]`` of the last batch, before it was normalised; 0 in empty slots.
    """

    advantage: Tensor

    def __init__(
        self,
        config: PPOConfig,
        features: int,
        low: float,
        high: float,
        device: torch.device | str = "cpu",
        point_mass: PointMass | None = None,
        size: int = 1,
    ) -> None:
        self.config, self.point_mass, self.size = config, point_mass, size
        self.actor = self.make_actor(features, low, high).to(device)
        self.policy = self.make_policy(low, high)
        self.critic = self.make_critic(features).to(device)
        self.loss = self.make_loss().to(device)
        self.loss.make_value_estimator()
        self.optimiser = torch.optim.Adam(self.loss.parameters(), lr=config.lr, eps=1e-5, fused=True)
        self.warm_start = WarmStart(0 if config.warm_start == "none" else config.warm_start_frames, config.kl_to_start)

    def make_actor(self, features: int, low: float, high: float) -> ProbabilisticActor:
        """Return the policy as the loss uses it, on flat rows."""
        return make_actor(features, low, high, self.config, self.point_mass, self.size)

    def make_policy(self, low: float, high: float) -> SamplingPolicy:
        """Return the policy for collection; it shares the parameters of ``actor``."""
        policy = SamplingPolicy if self.config.standardise else CompiledPolicy
        return policy(self.actor, low, high, self.point_mass, self.size)

    def make_critic(self, features: int) -> ValueOperator:
        """Return the value function as the loss uses it, on flat rows."""
        return make_critic(features, self.config)

    def make_loss(self) -> MaskedPPOLoss:
        """Return the loss of ``actor`` and ``critic``."""
        return MaskedPPOLoss(self.actor, self.critic, **self.loss_options())

    def loss_options(self) -> dict[str, Any]:
        """Return the loss's hyper-parameters."""
        config = self.config
        return {
            "clip_epsilon": config.clip_epsilon,
            "entropy_coeff": config.entropy_coeff,
            "critic_coeff": config.value_coeff,
            "loss_critic_type": config.value_loss,
            "value_error_clip": config.value_error_clip,
            "value_norm": make_value_norm(config.value_norm),
            "kl_coeff": config.kl_coeff,
            "gamma": config.gamma,
            "lmbda": config.gae_lambda,
        }

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Learn from a batch ``[N, T]`` of consecutive steps; see :class:`izoo.algos.learners.base.Algorithm`."""
        rows = self.advantages(batch)
        if len(rows) == 0:
            return {}
        for module in (*self.actor.modules(), *self.critic.modules()):
            if isinstance(module, base.Standardise):
                module.measure(rows.get(base.OBSERVATION))
        start, actor = self.warm_start, self.loss.actor_network
        imitates = start.imitating
        if imitates:
            rows.set(EXPERT_ACTION, batch.get(EXPERT_ACTION)[batch.get(base.MASK)])
        lr = self.config.warm_start_lr if imitates and self.config.warm_start_lr is not None else self.config.lr
        for group in self.optimiser.param_groups:
            group["lr"] = lr * max(1.0 - progress, 0.0) if self.config.anneal_lr else lr
        bound = None if imitates or self.config.target_kl is None else 1.5 * self.config.target_kl
        totals: dict[str, Tensor] = {}
        steps = 0
        for minibatch in self._minibatches(rows):
            losses = self.loss(minibatch)
            if start.active:
                with self.loss.actor_network_params.to_module(actor):
                    losses = start.losses(actor, minibatch, losses, progress)
            if bound is not None and float(losses["kl_approx"]) > bound:
                break
            total = sum(value for key, value in losses.items() if key.startswith("loss_"))
            self.optimiser.zero_grad()
            total.backward()  # type: ignore[union-attr]
            losses.update(self._clip())
            self.optimiser.step()
            for key, value in losses.items():
                totals[key] = totals.get(key, 0.0) + value.detach()
            steps += 1
        start.count(batch.numel(), self.loss.actor_network_params, progress)
        stats = {key: float(value) / steps for key, value in totals.items()}
        if not imitates:  # while it imitates, the penalty does not act
            self._adapt_kl_weight(stats.get("kl"))
        stats["lr"] = self.optimiser.param_groups[0]["lr"]
        stats["agent_rows"], stats["gradient_steps"] = float(len(rows)), float(steps)
        return stats

    def _clip(self) -> dict[str, Tensor]:
        """Bound the gradients; return their norms as they were."""
        bound = self.config.max_grad_norm or float("inf")
        if not self.config.separate_clips:
            return {"grad_norm": nn.utils.clip_grad_norm_(self.loss.parameters(), bound)}
        networks = {"actor": self.loss.actor_network_params, "critic": self.loss.critic_network_params}
        return {
            f"{name}_grad_norm": nn.utils.clip_grad_norm_(list(parameters.values(True, True)), bound)
            for name, parameters in networks.items()
        }

    @torch.no_grad()
    def advantages(self, batch: TensorDictBase) -> TensorDict:
        """Estimate advantages, normalised, and flatten: a batch ``[N, T]`` becomes rows ``[valid agent-steps]``."""
        estimated = batch.copy()
        for key in (("next", *base.REWARD), ("next", TEAM_REWARD)):
            reward = batch.get(key, None)
            if reward is not None:
                estimated.set(key, reward * self.config.reward_scale)
        self.loss.value_estimator(estimated)
        self.advantage = estimated.get(base.ADVANTAGE).squeeze(-1)
        rows = self.loss.rows(estimated)
        valid = rows.get(base.ADVANTAGE)
        if len(valid) > 1:
            rows.set(base.ADVANTAGE, (valid - valid.mean()) / valid.std().clamp_min(1e-6))
        return rows

    def _minibatches(self, rows: TensorDict) -> Iterator[TensorDict]:
        limit = self.config.rows_per_epoch or len(rows)
        for _ in range(self.config.epochs):
            order = torch.randperm(len(rows), device=rows.device)[:limit]
            for part in order.split(self.config.minibatch_rows):
                yield rows[part]

    def _adapt_kl_weight(self, divergence: float | None) -> None:
        if divergence is None:
            return
        if divergence > 2.0 * self.config.kl_target:
            self.loss.kl_weight.mul_(1.5)
        elif divergence < 0.5 * self.config.kl_target:
            self.loss.kl_weight.mul_(0.5)

    def state_dict(self) -> dict[str, Any]:
        """Return weights, optimiser state, the adaptive penalty and the scale of value targets."""
        return {
            "policy": self.policy.state_dict(),
            "critic": self.critic.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "kl_weight": float(self.loss.kl_weight),
            "value_norm": {} if self.loss.value_norm is None else self.loss.value_norm.state_dict(),
            "warm_start": self.warm_start.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.policy.load_state_dict(state["policy"])
        self.critic.load_state_dict(state["critic"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.loss.kl_weight.fill_(state["kl_weight"])
        if self.loss.value_norm is not None:
            self.loss.value_norm.load_state_dict(state["value_norm"])
        self.warm_start.load_state_dict(state["warm_start"], self.loss.actor_network_params)
