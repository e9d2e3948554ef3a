"""Proximal policy optimisation for interchangeable agents: one policy and one value function, shared by every CV.

Each agent-step is an independent sample (IPPO with shared parameters). Advantages are estimated per agent slot on the
batch ``[N, T]``; then the valid entries are flattened and TorchRL's own clipped loss does the rest, so that statistics,
normalisation and logs see no padding.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value.functional import generalized_advantage_estimate

from izoo.algos import base
from izoo.algos.action import Rest
from izoo.algos.gaussian import CompiledPolicy, SamplingPolicy, normal_parameters, tanh_normal
from izoo.algos.ppo_config import PPOConfig


def make_actor(
    features: int, low: float, high: float, config: PPOConfig, rest: Rest | None = None
) -> ProbabilisticActor:
    """Return the policy: a tanh-squashed normal over actions in ``[low, high]``; with ``rest``, a censored one.

    It works on the last dimension of ``("agents", "observation")``, for any number of agents or flat rows.
    """
    network = base.mlp(features, config.hidden, 2, config.activation, last_gain=0.01)
    extract = normal_parameters(network[-1], low, high, config.initial_accel_mps2, config.initial_spread, rest)  # type: ignore[arg-type]
    return tanh_normal(nn.Sequential(network, extract), [base.OBSERVATION], low, high, rest)


def make_critic(features: int, config: PPOConfig) -> ValueOperator:
    """Return the value function of one agent's own observation."""
    network = base.mlp(features, config.hidden, 1, config.activation, last_gain=1.0)
    return ValueOperator(network, in_keys=[base.OBSERVATION], out_keys=[base.VALUE])


class PPOLoss(ClipPPOLoss):
    """TorchRL's clipped loss on flat agent-steps, with the two optional terms that RLlib adds.

    Args:
        actor, critic: from :func:`make_actor` and :func:`make_critic`.
        config: hyper-parameters.
    """

    def __init__(self, actor: TensorDictSequential, critic: ValueOperator, config: PPOConfig) -> None:
        super().__init__(
            actor,
            critic,
            clip_epsilon=config.clip_epsilon,
            entropy_bonus=config.entropy_coeff > 0,
            entropy_coeff=config.entropy_coeff,
            critic_coeff=config.value_coeff,
            loss_critic_type=config.value_loss,
            normalize_advantage=False,
        )
        self.set_keys(
            action=base.ACTION,
            sample_log_prob=base.LOG_PROB,
            advantage=base.ADVANTAGE,
            value_target=base.VALUE_TARGET,
            value=base.VALUE,
            reward=base.REWARD,
            done=base.DONE,
            terminated=base.TERMINATED,
        )
        self.value_error_clip = config.value_error_clip
        self.register_buffer("kl_weight", torch.tensor(config.kl_coeff))

    def loss_critic(self, tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        """Return the value loss per row; errors beyond ``value_error_clip`` are flat."""
        loss, *rest = super().loss_critic(tensordict)
        if self.value_error_clip is not None:
            loss = loss.clamp(max=float(self.critic_coeff) * self.value_error_clip)
        return (loss, *rest)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses (scalars) of rows ``[n]``."""
        losses = super().forward(tensordict)
        if self.kl_weight > 0:
            divergence = self.divergence(tensordict).mean()
            losses.set("kl", divergence.detach())
            losses.set("loss_kl", self.kl_weight * divergence)
        return losses

    def divergence(self, tensordict: TensorDictBase) -> Tensor:
        """Return KL(collecting policy || policy) per row; the tanh, a bijection, does not change it.

        Of advice it is that of the normal before it is censored, which is no less.
        """
        old = torch.distributions.Normal(tensordict.get(base.LOC), tensordict.get(base.SCALE))
        with self.actor_network_params.to_module(self.actor_network):
            new = self.actor_network.get_dist(tensordict.select(*self.actor_network.in_keys)).base_dist
        return torch.distributions.kl_divergence(old, getattr(new, "base_dist", new)).sum(-1)


class PPO:
    """The algorithm: policy, value function, optimiser and update.

    Args:
        config: hyper-parameters.
        features: length ``F`` of an observation.
        low, high: bounds of the action: an acceleration in m/s^2, or advice.
        device: where the networks live.
        rest: that an action of 0 is doing nothing.
    """

    def __init__(
        self,
        config: PPOConfig,
        features: int,
        low: float,
        high: float,
        device: torch.device | str = "cpu",
        rest: Rest | None = None,
    ) -> None:
        self.config, self.rest = config, rest
        self.actor = self.make_actor(features, low, high).to(device)
        self.policy = self.make_policy(low, high)
        self.critic = self.make_critic(features).to(device)
        self.loss = PPOLoss(self.actor, self.critic, config).to(device)
        self.optimiser = torch.optim.Adam(self.loss.parameters(), lr=config.lr, eps=1e-5)

    def make_actor(self, features: int, low: float, high: float) -> ProbabilisticActor:
        """Return the policy as the loss uses it, on flat rows."""
        return make_actor(features, low, high, self.config, self.rest)

    def make_policy(self, low: float, high: float) -> SamplingPolicy:
        """Return the policy for collection; it shares the parameters of ``actor``."""
        return CompiledPolicy(self.actor, low, high, self.rest)

    def make_critic(self, features: int) -> ValueOperator:
        """Return the value function as the loss uses it, on flat rows."""
        return make_critic(features, self.config)

    def values(self, frames: TensorDictBase, where: Tensor) -> Tensor:
        """Return the values ``[where.sum(), 1]`` of the agents ``where`` ``[N, T, A]`` of ``frames`` ``[N, T]``."""
        return self.critic.module(frames.get(base.OBSERVATION)[where])

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Learn from a batch ``[N, T]`` of consecutive steps; see :class:`izoo.algos.base.Algorithm`."""
        rows = self.advantages(batch)
        if len(rows) == 0:
            return {}
        if self.config.anneal_lr:
            for group in self.optimiser.param_groups:
                group["lr"] = self.config.lr * max(1.0 - progress, 0.0)
        totals: dict[str, Tensor] = {}
        steps = 0
        for minibatch in self._minibatches(rows):
            losses = self.loss(minibatch)
            total = sum(value for key, value in losses.items() if key.startswith("loss_"))
            self.optimiser.zero_grad()
            total.backward()  # type: ignore[union-attr]
            losses["grad_norm"] = nn.utils.clip_grad_norm_(
                self.loss.parameters(), self.config.max_grad_norm or float("inf")
            )
            self.optimiser.step()
            for key, value in losses.items():
                totals[key] = totals.get(key, 0.0) + value.detach()
            steps += 1
        stats = {key: float(value) / steps for key, value in totals.items()}
        self._adapt_kl_weight(stats.get("kl"))
        stats["lr"] = self.optimiser.param_groups[0]["lr"]
        stats["agent_rows"] = float(len(rows))
        return stats

    @torch.no_grad()
    def advantages(self, batch: TensorDictBase) -> TensorDict:
        """Estimate advantages and flatten: a batch ``[N, T]`` becomes rows ``[valid agent-steps]``."""
        mask, done = batch.get(base.MASK), batch.get(("next", *base.DONE))
        terminated, reward = batch.get(("next", *base.TERMINATED)), batch.get(("next", *base.REWARD))
        # What stands in an empty slot must not reach its neighbours in time, whatever it is.
        reward = torch.where(mask.unsqueeze(-1), reward, torch.zeros_like(reward))
        value = torch.zeros_like(reward)
        value[mask] = self.values(batch, mask)
        boundary = mask & done.squeeze(-1)
        boundary[:, -1] = mask[:, -1]
        goes_on = boundary & ~terminated.squeeze(-1)
        bootstrap = torch.zeros_like(value)
        bootstrap[goes_on] = self.values(batch.get("next"), goes_on)
        advantage, target = generalized_advantage_estimate(
            self.config.gamma,
            self.config.gae_lambda,
            value,
            base.next_values(value, boundary, bootstrap[boundary]),
            reward * self.config.reward_scale,
            done,
            terminated,
            time_dim=1,
        )
        keys = [base.OBSERVATION, base.ACTION, base.LOG_PROB, base.LOC, base.SCALE]
        if self.rest is not None and self.rest.two_sided:
            keys.append(base.GUIDED)
        rows = base.agent_rows(batch, keys)
        valid = advantage[mask]
        if len(valid) > 1:
            valid = (valid - valid.mean()) / valid.std().clamp_min(1e-6)
        rows.update({base.ADVANTAGE: valid, base.VALUE_TARGET: target[mask]})
        flat = TensorDict(batch_size=[len(valid)], device=valid.device)
        for key, rows_of_key in rows.items():
            flat.set(key, rows_of_key)
        return flat

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
        """Return weights, optimiser state and the adaptive penalty."""
        return {
            "policy": self.policy.state_dict(),
            "critic": self.critic.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "kl_weight": float(self.loss.kl_weight),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.policy.load_state_dict(state["policy"])
        self.critic.load_state_dict(state["critic"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.loss.kl_weight.fill_(state["kl_weight"])
