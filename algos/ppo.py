"""Proximal policy optimisation for interchangeable agents: one policy and one value function, shared by every CV.

Each agent-step is an independent sample (IPPO with shared parameters). Advantages are estimated per agent slot on the
batch ``[N, T]``; then the valid entries are flattened and TorchRL's own clipped loss does the rest, so that statistics,
normalisation and logs see no padding.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value.functional import generalized_advantage_estimate

from izoo.algos import base
from izoo.algos.gaussian import SamplingPolicy, normal_parameters, tanh_normal
from izoo.errors import IzooError, check_choice, check_range


@dataclass(frozen=True)
class PPOConfig:
    """Hyper-parameters of PPO; the defaults are the preset ``tuned``.

    Sources: "RLlib" is the default of Ray RLlib 2.11 (``rllib/algorithms/ppo/ppo.py`` and ``models/catalog.py``), which
    the paper used; "Schulman" is arXiv 1707.06347; "Andrychowicz" is arXiv 2006.05990; "ours" was chosen by short runs.

    Attributes:
        name: the algorithm.
        frames_per_batch: environment steps, over all workers, between two updates (RLlib collects whole episodes on
            ten workers here: 10 x 1,950; ours: 3,900, two episodes).
        rows_per_epoch: agent-steps drawn at random, without replacement, for each epoch; ``null`` uses all (RLlib).
            The agents of one step are paid alike and see much the same, so a part of them carries most of the
            information (ours).
        epochs: passes over the batch (RLlib 30; ours 4).
        minibatch_rows: agent-steps per gradient step (RLlib 128; ours 1,024, for speed).
        lr: Adam's learning rate (RLlib 5e-5; Schulman 3e-4; ours 5e-4, annealed).
        anneal_lr: lower the learning rate linearly to 0 over the run (Schulman, Andrychowicz; RLlib does not).
        gamma: discount per step of 0.5 s (RLlib 0.99: a horizon of 50 s; ours the same).
        gae_lambda: trace decay of generalised advantage estimation (RLlib 1.0; Schulman 0.95, which is ours).
        clip_epsilon: bound on the change of the probability ratio (RLlib 0.3; Schulman 0.2, which is ours).
        value_coeff: weight of the value loss (RLlib 1.0; ours 0.5). The networks are separate, so with Adam it matters
            for gradient clipping alone.
        value_loss: ``l2`` (RLlib) or ``smooth_l1`` (ours: bounded gradients).
        value_error_clip: squared value errors above this give no gradient (RLlib 10); ``null`` for none (ours).
        entropy_coeff: weight of the entropy bonus (RLlib 0; ours the same).
        kl_coeff: initial weight of the penalty on the divergence from the collecting policy (RLlib 0.2; ours 0).
        kl_target: divergence at which that weight stays; it grows above twice this, and shrinks below half of it (RLlib
            0.01).
        max_grad_norm: bound on the gradient's norm; ``null`` for none (RLlib none; Andrychowicz 0.5, which is ours).
        reward_scale: rewards are multiplied by it before advantages are estimated (RLlib 1; ours 0.1, so that values
            are of order 1 and the value function learns within a few batches).
        hidden: widths of the hidden layers of each of the two networks (RLlib 256, 256; ours 128, 128).
        activation: ``tanh`` (RLlib, Andrychowicz), ``relu`` or ``silu``.
        initial_accel_mps2: median acceleration of the untrained policy. Vehicles that hardly accelerate block the road,
            and vehicles at full throttle learn slowly to do less (RLlib: middle of the range, -0.95; ours 0.5).
        initial_spread: standard deviation of the untrained policy before the tanh (RLlib 1; ours 0.35, about 1 m/s^2).
    """

    name: Literal["ppo"] = "ppo"
    frames_per_batch: int = 3900
    rows_per_epoch: int | None = 32768
    epochs: int = 4
    minibatch_rows: int = 1024
    lr: float = 5e-4
    anneal_lr: bool = True
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_epsilon: float = 0.2
    value_coeff: float = 0.5
    value_loss: Literal["l2", "smooth_l1"] = "smooth_l1"
    value_error_clip: float | None = None
    entropy_coeff: float = 0.0
    kl_coeff: float = 0.0
    kl_target: float = 0.01
    max_grad_norm: float | None = 0.5
    reward_scale: float = 0.1
    hidden: tuple[int, ...] = (128, 128)
    activation: Literal["tanh", "relu", "silu"] = "tanh"
    initial_accel_mps2: float = 0.5
    initial_spread: float = 0.35

    def __post_init__(self) -> None:
        for name in ("frames_per_batch", "epochs", "minibatch_rows"):
            check_range(f"algo.{name}", getattr(self, name), 1, 10**9)
        if self.rows_per_epoch is not None:
            check_range("algo.rows_per_epoch", self.rows_per_epoch, 1, 10**9)
        for name in ("gamma", "gae_lambda"):
            check_range(f"algo.{name}", getattr(self, name), 0.0, 1.0)
        for name in ("lr", "clip_epsilon", "reward_scale", "initial_spread"):
            check_range(f"algo.{name}", getattr(self, name), 1e-12, 100.0)
        check_choice("algo.activation", self.activation, base.ACTIVATIONS)
        if not self.hidden or min(self.hidden) < 1:
            raise IzooError(
                f"algo.hidden is {list(self.hidden)}; it needs one or more positive widths, like [128,128]."
            )

    @classmethod
    def paper(cls) -> PPOConfig:
        """Return the preset ``paper``: RLlib 2.11's defaults, as the paper used them.

        RLlib samples a normal distribution and clips it to the action range, where this squashes it with a tanh.
        """
        return cls(
            frames_per_batch=19500,
            rows_per_epoch=None,
            epochs=30,
            minibatch_rows=128,
            lr=5e-5,
            anneal_lr=False,
            gae_lambda=1.0,
            clip_epsilon=0.3,
            value_coeff=1.0,
            value_loss="l2",
            value_error_clip=10.0,
            kl_coeff=0.2,
            max_grad_norm=None,
            reward_scale=1.0,
            hidden=(256, 256),
            initial_accel_mps2=-0.95,
            initial_spread=1.0,
        )


def make_actor(features: int, low: float, high: float, config: PPOConfig) -> ProbabilisticActor:
    """Return the policy: a tanh-squashed normal over accelerations in ``[low, high]`` m/s^2.

    It works on the last dimension of ``("agents", "observation")``, for any number of agents or flat rows.
    """
    network = base.mlp(features, config.hidden, 2, config.activation, last_gain=0.01)
    extract = normal_parameters(network[-1], low, high, config.initial_accel_mps2, config.initial_spread)  # type: ignore[arg-type]
    return tanh_normal(nn.Sequential(network, extract), [base.OBSERVATION], low, high)


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
        """Return KL(collecting policy || policy) per row; the tanh, a bijection, does not change it."""
        old = torch.distributions.Normal(tensordict.get(base.LOC), tensordict.get(base.SCALE))
        with self.actor_network_params.to_module(self.actor_network):
            new = self.actor_network.get_dist(tensordict.select(*self.actor_network.in_keys)).base_dist
        return torch.distributions.kl_divergence(old, getattr(new, "base_dist", new)).sum(-1)


class PPO:
    """The algorithm: policy, value function, optimiser and update.

    Args:
        config: hyper-parameters.
        features: length ``F`` of an observation.
        low, high: bounds of the acceleration, m/s^2.
        device: where the networks live.
    """

    def __init__(
        self, config: PPOConfig, features: int, low: float, high: float, device: torch.device | str = "cpu"
    ) -> None:
        self.config = config
        self.actor = self.make_actor(features, low, high).to(device)
        self.policy = self.make_policy(low, high)
        self.critic = self.make_critic(features).to(device)
        self.loss = PPOLoss(self.actor, self.critic, config).to(device)
        self.optimiser = torch.optim.Adam(self.loss.parameters(), lr=config.lr, eps=1e-5)

    def make_actor(self, features: int, low: float, high: float) -> ProbabilisticActor:
        """Return the policy as the loss uses it, on flat rows."""
        return make_actor(features, low, high, self.config)

    def make_policy(self, low: float, high: float) -> SamplingPolicy:
        """Return the policy for collection; it shares the parameters of ``actor``."""
        return SamplingPolicy(self.actor, low, high)

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
        rows = base.agent_rows(batch, [base.OBSERVATION, base.ACTION, base.LOG_PROB, base.LOC, base.SCALE])
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
