"""Proximal policy optimisation for interchangeable agents: one policy and one value function, shared by every CV.

Each agent-step is an independent sample (IPPO with shared parameters). Advantages are estimated per agent slot on the
batch ``[N, T]``; then the valid entries are flattened, once for all minibatches (:mod:`izoo.algos.losses`).
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import CudaGraphModule
from tensordict.nn.functional_modules import _exclude_td_from_pytree
from torch import Tensor, nn
from torchrl.modules import PopArtValueNorm, ProbabilisticActor, RunningValueNorm, ValueNorm, ValueOperator

from izoo.algos.actions.action_modes import SPREADS, ActionSpace, AdviseAction
from izoo.algos.learners import base
from izoo.algos.learners.imitation import EXPERT_ACTION, WarmStart
from izoo.algos.learners.registry import ON_TWIN, AlgoConfig
from izoo.algos.losses import MaskedPPOLoss
from izoo.algos.losses.masked_gae import TEAM_REWARD
from izoo.algos.networks.gaussian import CommonNoise, CompiledPolicy, SamplingPolicy, normal_parameters, tanh_normal
from izoo.algos.networks.masking import is_set_module
from izoo.envs import REFERENCE
from izoo.envs.config import BY_STEP, RewardConfig
from izoo.errors import IzooError
from izoo.options import Ranges

if TYPE_CHECKING:
    from typing_extensions import Self

POPART_BETA = 0.99
"""What is left of a batch's weight in the statistics one batch later."""


@dataclass(frozen=True)
class PPOConfig(AlgoConfig):
    """Hyper-parameters of PPO; the defaults are ours.

    Sources: "RLlib" is the default of Ray RLlib 2.11 (``rllib/algorithms/ppo/ppo.py`` and ``models/catalog.py``), which
    the paper used; "Schulman" is arXiv 1707.06347; "Andrychowicz" is arXiv 2006.05990; "ours" was chosen by short runs.

    Attributes:
        name: the algorithm.
        frames_per_batch: environment steps, over all workers, between two updates (RLlib collects whole episodes on
            ten workers here: 10 x 1,950; ours: 3,900, two episodes).
        rows_per_epoch: agent-steps drawn at random, without replacement, for each epoch; ``null`` uses all (RLlib).
            The agents of one step have similar rewards and see much the same, so a part of them carries most of the
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
        value_norm: ``none`` (RLlib, ours), or how the scale of value targets is followed, in which the value function
            then learns, since returns differ a hundredfold between contexts: ``running``, mean and spread of all
            targets so far; ``popart``, of those of the last hundred batches or so (TorchRL's modules of these names).
        value_error_clip: squared value errors above this give no gradient (RLlib 10); ``null`` for none (ours).
        entropy_coeff: weight of the entropy bonus (RLlib 0; ours the same).
        kl_coeff: initial weight of the penalty on the divergence from the collecting policy (RLlib 0.2; ours 0).
        kl_target: divergence at which that weight stays; it grows above twice this, and shrinks below half of it (RLlib
            0.01).
        target_kl: a batch is learned from no further once the policy diverges, on a minibatch, from the one that
            collected by more than one and a half times this (as in Stable-Baselines3; 0.01 to 0.02 is usual); ``null``:
            all epochs (RLlib, ours). Nothing is learned from the minibatch that shows it.
        separate_clips: bound the gradients of actor and critic each by itself, so that large value errors do not
            silence the actor (RLlib, ours: both together).
        max_grad_norm: bound on the gradient's norm; ``null`` for none (RLlib none; Andrychowicz 0.5, which is ours).
        reward_scale: rewards are multiplied by it before advantages are estimated (RLlib 1; ours 0.1, so that values
            are of order 1 and the value function learns within a few batches).
        control_variate: ``vehicle``: a vehicle's reward minus that of the same vehicle, from the same time on, in the
            uncommanded episode of the same context and seed, which is played during training: less variance, no bias
            (:func:`izoo.algos.learners.decisions.shaped`). Needs ``simulator=twin``. ``none``:
            nothing (ours).
        common_noise: share of the variance of the exploration that all vehicles of an episode have in common: 0, each
            explores alone (ours); 1, all choose faster, or slower, than the policy says. Then a vehicle's return also
            shows what it gains when the others do the same. Needs ``simulator=twin`` and decisions that are taken once.
        warm_start: a scripted driver that the policy imitates before reinforcement: ``glide``, or ``none``.
            Needs ``action=advise``, in which both can leave a CV alone.
        warm_start_frames: environment steps, over all environments, of the imitation.
        warm_start_lr: learning rate of the imitation; ``null``: ``lr``.
        kl_to_start: weight of a penalty on the divergence from the imitation as it was at its end; it falls linearly to
            0 at the end of the run (ours 1; 0: none).
        standardise: subtract the mean from each feature of an observation and divide it by its spread, as they are in
            the first batch (Andrychowicz: of all observations so far; RLlib and ours: not).
        hidden: widths of the hidden layers of each of the two networks (RLlib 256, 256; ours 128, 128).
        activation: ``tanh`` (RLlib, Andrychowicz), ``relu`` or ``silu``.
        initial_accel_mps2: median acceleration of the untrained policy; ``null``: the middle of the range. Vehicles
            that hardly accelerate block the road, and vehicles at full throttle learn slowly to do less (RLlib: the
            middle; ours 0.5). With ``action=advise`` or ``residual`` the untrained action is 0 instead.
        initial_spread: standard deviation of the untrained policy before the tanh (RLlib 1; ours 0.35, about 1 m/s^2).
            With ``action=advise`` or ``residual`` it is ``action.spread`` instead.
    """

    name: str = "ppo"
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
    value_norm: Literal["none", "running", "popart"] = "none"
    value_error_clip: float | None = None
    entropy_coeff: float = 0.0
    kl_coeff: float = 0.0
    kl_target: float = 0.01
    target_kl: float | None = None
    separate_clips: bool = False
    max_grad_norm: float | None = 0.5
    reward_scale: float = 0.1
    control_variate: Literal["none", "vehicle"] = "none"
    common_noise: float = 0.0
    warm_start: Literal["none", "glide"] = "none"
    warm_start_frames: int = 100_000
    warm_start_lr: float | None = None
    kl_to_start: float = 1.0
    standardise: bool = False
    hidden: tuple[int, ...] = (128, 128)
    activation: Literal["tanh", "relu", "silu"] = "tanh"
    initial_accel_mps2: float | None = 0.5
    initial_spread: float = 0.35

    ranges: ClassVar[Ranges] = (
        ("epochs minibatch_rows rows_per_epoch", 1, 10**9),
        ("gamma gae_lambda common_noise", 0.0, 1.0),
        ("lr warm_start_lr reward_scale kl_target", 1e-12, 100.0),
        ("target_kl", 1e-6, 100.0),
        ("clip_epsilon", 1e-12, 0.999),
        ("initial_spread", *SPREADS),
        ("value_coeff entropy_coeff kl_coeff kl_to_start", 0.0, 1e6),
        ("max_grad_norm value_error_clip", 1e-9, 1e9),
        ("warm_start_frames", 1, 10**12),
    )
    starts_with: ClassVar[str] = "layers"
    estimates_advantages = True
    runs: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "vehicle": {**ON_TWIN, "num_envs": 64, "total_frames": 92_160, "validation": {"every_batches": 20}},
        "imitation": {
            **ON_TWIN,
            "action": AdviseAction(),
            "env": {**BY_STEP, "hold_s": 2.0, "reward": RewardConfig()},
            "num_envs": 32,
            "total_frames": 96_000,
            "validation": {"every_batches": 2, "contexts": 6, "seeds": 3, "simulator": REFERENCE},
        },
    }

    @property
    def variate(self) -> str:
        """What the uncommanded episode's rewards are subtracted from."""
        return self.control_variate

    def __post_init__(self) -> None:
        super().__post_init__()
        base.check_widths("algo.hidden", self.hidden)

    def check_run(self, run: Any) -> None:
        """Raise :class:`IzooError` where other options of a run do not go with these."""
        super().check_run(run)
        if self.warm_start != "none" and run.action.name != "advise":
            raise IzooError(
                f"algo.warm_start={self.warm_start} imitates a driver that leaves most CVs alone, which action="
                f"{run.action.name} cannot say; choose action=advise, or algo.warm_start=none."
            )

    @classmethod
    def vehicle(cls) -> Self:
        """Return the preset ``vehicle``: for tasks in which a CV decides once, with few and long decisions."""
        return cls(
            frames_per_batch=1536,
            epochs=6,
            lr=5e-3,
            separate_clips=True,
            max_grad_norm=1.0,
            control_variate="vehicle",
            activation="relu",
        )

    @classmethod
    def imitation(cls) -> Self:
        """Return the preset ``imitation``: the policy imitates glide, every 2 s, for the whole run."""
        return cls(
            frames_per_batch=9600,
            minibatch_rows=512,
            lr=2e-3,
            separate_clips=True,
            max_grad_norm=2.0,
            warm_start="glide",
            warm_start_frames=96_000,
            activation="relu",
        )

    @classmethod
    def paper(cls) -> Self:
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
            initial_accel_mps2=None,
            initial_spread=1.0,
        )


def make_actor(features: int, space: ActionSpace, config: PPOConfig) -> ProbabilisticActor:
    """Return the policy: a tanh-squashed normal over the actions; with a point mass, a censored one.

    It works on the last dimension of ``("agents", "observation")``, for any number of agents or flat rows.
    """
    network = base.mlp(features, config.hidden, 2 * space.size, config.activation, 0.01, config.standardise)
    extract = normal_parameters(network[-1], space, config.initial_accel_mps2, config.initial_spread)  # type: ignore[arg-type]
    return tanh_normal(nn.Sequential(network, extract), [base.OBSERVATION], space)


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
        space: of its actions.
        device: where the networks live.

    Attributes:
        advantage: ``[N, T, A]`` of the last batch, before it was normalised; 0 in empty slots.
        weights: what is learned, by ``actor`` and ``critic``.
    """

    options: type[AlgoConfig] = PPOConfig
    advantage: Tensor

    def __init__(
        self, config: PPOConfig, features: int, space: ActionSpace, device: torch.device | str = "cpu"
    ) -> None:
        self.config, self.space = config, space
        self.actor = self.make_actor(features).to(device)
        self.policy = self.make_policy()
        if config.common_noise > 0.0:
            self.policy.common_noise = CommonNoise(config.common_noise, int(torch.randint(2**31 - 1, ())))
        self.critic = self.make_critic(features).to(device)
        self.loss = self.make_loss().to(device)
        self.loss.make_value_estimator()
        networks = {"actor": self.loss.actor_network, "critic": self.loss.critic_network}
        self.weights = {name: list(network.parameters()) for name, network in networks.items()}
        on_gpu = torch.device(device).type == "cuda"
        self._lr = torch.tensor(config.lr, device=device) if on_gpu else config.lr
        self.optimiser = torch.optim.Adam(self.loss.parameters(), self._lr, eps=1e-5, fused=True, capturable=on_gpu)
        self._replayed = self._make_replayed() if on_gpu else None
        self.warm_start = WarmStart(0 if config.warm_start == "none" else config.warm_start_frames, config.kl_to_start)

    def make_actor(self, features: int) -> ProbabilisticActor:
        """Return the policy as the loss uses it, on flat rows."""
        return make_actor(features, self.space, self.config)

    def make_policy(self) -> SamplingPolicy:
        """Return the policy for collection; it shares the parameters of ``actor``."""
        policy = SamplingPolicy if self.config.standardise else CompiledPolicy
        return policy(self.actor, self.space)

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
            "functional": False,  # its parameters are those of the networks: nothing is swapped in at each minibatch
        }

    def _make_replayed(self) -> CudaGraphModule | None:
        """Return a gradient step whose work on the GPU is recorded once and then replayed: launching it takes longer.

        ``None`` where it depends on the numbers: on which vehicles are near, on censored actions, or on values' scale.
        """
        seen = any(is_set_module(network) for network in (self.loss.actor_network, self.loss.critic_network))
        if seen or self.space.point_mass is not None or self.loss.value_norm is not None:
            return None
        logging.getLogger("tensordict").setLevel(logging.WARNING)  # it tells when it records
        _exclude_td_from_pytree().set()  # the graph does so too, with a warning
        return CudaGraphModule(lambda rows: self._descend(self.loss.of_rows(rows)), in_keys=[], out_keys=[])

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
        self._set_lr(lr * max(1.0 - progress, 0.0) if self.config.anneal_lr else lr)
        bound = None if imitates or self.config.target_kl is None else 1.5 * self.config.target_kl
        replayed = None if start.active or bound is not None else self._replayed
        found: list[Any] = []
        for minibatch in self._minibatches(rows):
            if replayed is not None and len(minibatch) == self.config.minibatch_rows:
                found.append(replayed(minibatch))
                continue
            losses = self.loss.of_rows(minibatch)
            if start.active:
                losses = start.losses(actor, minibatch, losses, progress)
            if bound is not None and float(losses["kl_approx"]) > bound:
                break
            found.append(self._descend(losses))
        start.count(batch.numel(), actor, progress)
        means: Any = torch.stack(found).mean(0) if found else {}
        stats = {key: float(value) for key, value in means.items()}
        if not imitates:  # while it imitates, the penalty does not act
            self._adapt_kl_weight(stats.get("kl"))
        stats["lr"], stats["gradient_steps"] = float(self._lr), float(len(found))
        return stats

    def _set_lr(self, lr: float) -> None:
        if isinstance(self._lr, Tensor):
            self._lr.fill_(lr)
        else:
            self._lr = lr
        for group in self.optimiser.param_groups:
            group["lr"] = self._lr

    def _descend(self, losses: TensorDictBase) -> TensorDictBase:
        """Follow the gradient of the losses; return them, and the gradients' norms as they were."""
        total = sum(value for key, value in losses.items() if key.startswith("loss_"))  # type: ignore[misc]
        self.optimiser.zero_grad()
        total.backward()  # type: ignore[union-attr]
        losses.update(self._clip())
        self.optimiser.step()
        return losses.detach()

    def _clip(self) -> dict[str, Tensor]:
        """Bound the gradients; return their norms as they were."""
        bound = self.config.max_grad_norm or float("inf")
        if not self.config.separate_clips:
            return {"grad_norm": nn.utils.clip_grad_norm_([*self.weights["actor"], *self.weights["critic"]], bound)}
        return {f"{name}_grad_norm": nn.utils.clip_grad_norm_(weights, bound) for name, weights in self.weights.items()}

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
            yield from rows[order].split(self.config.minibatch_rows)

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
        for group in self.optimiser.param_groups:  # another device may have saved it
            group["capturable"] = isinstance(self._lr, Tensor)
        self._replayed = None if self._replayed is None else self._make_replayed()
        self.loss.kl_weight.fill_(state["kl_weight"])
        if self.loss.value_norm is not None:
            self.loss.value_norm.load_state_dict(state["value_norm"])
        self.warm_start.load_state_dict(state["warm_start"], self.loss.actor_network)
