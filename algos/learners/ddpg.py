"""Deep deterministic policy gradient for interchangeable agents: one actor and one critic, shared by every CV.

Each agent transition is an independent sample: the critic sees one agent's observation and acceleration. Valid
transitions are stored flat (:mod:`izoo.algos.learners.replay`), and TorchRL's own loss works on them, so that losses
and logs see no padding.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import ValueOperator
from torchrl.objectives import LossModule, SoftUpdate

from izoo.algos.actions.action_modes import ActionSpace
from izoo.algos.learners import base
from izoo.algos.learners.registry import AlgoConfig
from izoo.algos.learners.replay import ERROR, Replay, transitions
from izoo.algos.losses import MaskedDDPGLoss
from izoo.algos.networks import compiled_mlp
from izoo.algos.networks.set_networks import spread_out
from izoo.envs.config import SPEED
from izoo.errors import check_range
from izoo.options import Ranges


@dataclass(frozen=True)
class DDPGConfig(AlgoConfig):
    """Hyper-parameters of DDPG; the defaults are ours.

    Sources: "RLlib" is the default of RLlib's DDPG, which the paper used with Ray 2.11 (since Ray 2.8 in
    ``rllib_contrib/ddpg/src/rllib_ddpg/ddpg/ddpg.py``); "Lillicrap" is arXiv 1509.02971; "TD3" is arXiv 1802.09477;
    "Schaul" is arXiv 1511.05952; "ours" was chosen by short runs here.

    Attributes:
        name: the algorithm.
        frames_per_batch: environment steps, over all workers, between two rounds of updates (RLlib: one step of each of
            ten workers; ours 1,950, one episode, since a round has a fixed cost).
        updates_per_frame: gradient steps per environment step (RLlib one per step of ten workers, so 0.1; ours 0.2).
        minibatch_rows: transitions per gradient step (RLlib, ours 256; Lillicrap 64).
        replay_rows: transitions held; of 60 features each takes 500 bytes (RLlib 50,000; Lillicrap 1e6; ours 100,000,
            50 MB).
        rows_per_frame: most transitions stored per environment step, drawn at random from a batch; ``null`` stores all
            (RLlib). The agents of one step see much the same, so a part of them lets the replay reach further back
            (ours 2).
        learning_starts: environment steps before the first update (RLlib 1,500; ours 3,900).
        random_frames: environment steps of uniformly random accelerations at the start, counted in whole batches (RLlib
            1,000; ours 0: the mean of the range is braking, and a jam teaches little).
        priority_alpha: exponent of prioritised replay; 0 draws uniformly (RLlib, Schaul 0.6; Lillicrap, ours 0).
        priority_beta: exponent of its correction (RLlib, Schaul 0.4).
        actor_lr: Adam's learning rate of the actor (RLlib 1e-3; Lillicrap 1e-4; ours 3e-4).
        critic_lr: that of the critic (RLlib, Lillicrap 1e-3, which is ours).
        weight_decay: of both networks (RLlib 1e-6; Lillicrap 1e-2 on the critic; ours 0).
        tau: share by which target networks follow at each update (RLlib 0.002; Lillicrap 0.001; TD3 0.005; ours
            0.01).
        gamma: discount per step of 0.5 s (RLlib, Lillicrap 0.99, which is ours).
        n_step: steps whose rewards are summed before the critic takes over (RLlib, Lillicrap 1; ours 20, 10 s: a step
            of 0.5 s changes little, and values spread back through the target networks that much faster; the noise on
            the later actions is small enough to go uncorrected). Where CVs do not decide in every step, a row is one
            whole decision, and this has no effect.
        saturation_coeff: weight in the actor's loss of the squared distance, before the tanh, from the untrained output
            (RLlib, Lillicrap 0; arXiv 1707.01495, from 0 and with 1; ours 0.02). Without it a critic that is wrong at
            first drives the actor to full throttle everywhere, where the tanh has no gradient to bring it back.
        value_loss: ``l2`` (RLlib, Lillicrap) or ``smooth_l1`` (ours: bounded gradients).
        max_grad_norm: bound on each network's gradient; ``null`` for none (RLlib; ours 1).
        reward_scale: rewards are multiplied by it (RLlib 1; ours 0.1, so that values are of order 1).
        control_variate: ``vehicle``: a vehicle's reward minus that of the same vehicle, from the same time on, in the
            uncommanded episode of the same context and seed, which is played during training: less variance, no bias
            (:func:`izoo.algos.learners.decisions.shaped`). Needs ``simulator=twin``. ``none``:
            nothing (ours).
        noise_theta: share of the exploration noise that decays per step; 1 makes it white, less makes it an
            Ornstein-Uhlenbeck process of its own for each vehicle (RLlib, Lillicrap 0.15, which is ours).
        noise_sigma: standard deviation of what is added to it per step, in widths of the action's range (RLlib
            0.1 x 0.2 = 0.02; Lillicrap 0.2 of half the width; ours 0.06, which makes about 0.8 m/s^2 in all).
        noise_final: factor on the noise at the end of its decay (RLlib 0.02; ours 0.2).
        noise_frames: environment steps in which that factor falls linearly from 1; ``null``: the whole run (RLlib
            10,000; ours the whole run).
        hidden: widths of the hidden layers of each network (RLlib, Lillicrap 400, 300; ours 128, 128).
        activation: ``relu`` (RLlib, Lillicrap), ``tanh`` or ``silu``.
        initial_accel_mps2: acceleration of the untrained actor; ``null``: the middle of the range (RLlib: that; ours
            0.5). With ``action=advise`` or ``residual`` the untrained action is 0 instead.
        stores: what a transition holds as the action: ``commanded``, what the policy chose, or ``applied``, what came
            of it. The simulator's own driver may brake harder than a command asks, and then every such command does
            the same; ``applied`` stores the acceleration that the vehicle had, and of advice that changed nothing that
            none was given. With ``action=speed`` it is always what was chosen.
        save_replay: write the replay into checkpoints, so that a resumed run goes on exactly as it would have; without
            it checkpoints are small, and a resumed run collects ``learning_starts`` steps before it learns again.
    """

    name: str = "ddpg"
    frames_per_batch: int = 1950
    updates_per_frame: float = 0.2
    minibatch_rows: int = 256
    replay_rows: int = 100_000
    rows_per_frame: float | None = 2.0
    learning_starts: int = 3900
    random_frames: int = 0
    priority_alpha: float = 0.0
    priority_beta: float = 0.4
    actor_lr: float = 3e-4
    critic_lr: float = 1e-3
    weight_decay: float = 0.0
    tau: float = 0.01
    gamma: float = 0.99
    n_step: int = 20
    saturation_coeff: float = 0.02
    value_loss: Literal["l2", "smooth_l1"] = "smooth_l1"
    max_grad_norm: float | None = 1.0
    reward_scale: float = 0.1
    control_variate: Literal["none", "vehicle"] = "none"
    noise_theta: float = 0.15
    noise_sigma: float = 0.06
    noise_final: float = 0.2
    noise_frames: int | None = None
    hidden: tuple[int, ...] = (128, 128)
    activation: Literal["tanh", "relu", "silu"] = "relu"
    initial_accel_mps2: float | None = 0.5
    stores: Literal["commanded", "applied"] = "commanded"
    save_replay: bool = True

    ranges: ClassVar[Ranges] = (
        ("minibatch_rows replay_rows n_step", 1, 10**9),
        ("learning_starts random_frames", 0, 10**12),
        ("priority_alpha priority_beta gamma noise_theta noise_final weight_decay", 0.0, 1.0),
        ("updates_per_frame actor_lr critic_lr reward_scale", 1e-12, 100.0),
        ("tau", 1e-9, 0.5),
        ("noise_sigma saturation_coeff", 0.0, 10.0),
        ("max_grad_norm", 1e-9, 1e9),
        ("rows_per_frame", 1e-3, 10**6),
        ("noise_frames", 1, 10**12),
    )

    @property
    def variate(self) -> str:
        """What the uncommanded episode's rewards are subtracted from."""
        return self.control_variate

    def __post_init__(self) -> None:
        super().__post_init__()
        base.check_widths("algo.hidden", self.hidden)

    def by_step(self, run: Any) -> tuple[str, ...]:
        """Return the options with which it learns from decisions in every step alone."""
        return ("algo.stores=applied",) if self.stores == "applied" and run.env.action != SPEED else ()

    @classmethod
    def paper(cls) -> DDPGConfig:
        """Return the preset ``paper``: RLlib's defaults, which the paper says it used.

        Four differences remain: updates come in rounds instead of after each step; each vehicle has noise of its own,
        where RLlib's is one process for all; the weights of prioritised replay apply to the actor's loss as well; and
        the released script (``ddpg_training.py``) lets ten workers play whole episodes before each gradient step, by
        which RLlib makes one per 19,500 environment steps, 500 in the whole run: next to no training. This preset has
        one per ten steps, as where RLlib's defaults are left alone.
        """
        return cls(
            frames_per_batch=390,
            updates_per_frame=0.1,
            replay_rows=50_000,
            rows_per_frame=None,
            learning_starts=1500,
            random_frames=1000,
            priority_alpha=0.6,
            actor_lr=1e-3,
            weight_decay=1e-6,
            tau=0.002,
            n_step=1,
            saturation_coeff=0.0,
            value_loss="l2",
            max_grad_norm=None,
            reward_scale=1.0,
            noise_sigma=0.02,
            noise_final=0.02,
            noise_frames=10_000,
            hidden=(400, 300),
            initial_accel_mps2=None,
        )


class Squash(nn.Module):
    """Maps any number into the range of actions by a tanh."""

    def __init__(self, space: ActionSpace) -> None:
        super().__init__()
        self.middle, self.half_width = space.middle, space.half_width

    def forward(self, raw: Tensor) -> Tensor:
        """Return accelerations of the same shape, m/s^2."""
        return torch.tanh(raw) * self.half_width + self.middle


class ActionValue(nn.Module):
    """Q(o, a) of one agent's own observation and action, which enters scaled to [-1, 1]."""

    def __init__(self, features: int, space: ActionSpace, config: DDPGConfig) -> None:
        super().__init__()
        self.middle, self.half_width = space.middle, space.half_width
        self.network = base.mlp(features + space.size, config.hidden, 1, config.activation, last_gain=1.0)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Return values ``[*B, 1]`` of observations ``[*B, F]`` and actions ``[*B, D]``."""
        return self.network(torch.cat([observation, (action - self.middle) / self.half_width], dim=-1))


def make_actor(features: int, space: ActionSpace, config: DDPGConfig) -> TensorDictModule:
    """Return the deterministic policy, for any number of agents or flat rows ``[*B, F]``; with a point mass, its
    untrained action is 0."""
    initial = config.initial_accel_mps2 if space.point_mass is None else 0.0
    initial = space.middle if initial is None else initial
    check_range("algo.initial_accel_mps2", initial, space.low + 1e-3, space.high - 1e-3, "m/s^2")
    network = base.mlp(features, config.hidden, space.size, config.activation, last_gain=0.01)
    with torch.no_grad():
        network[-1].bias[:] = math.atanh((initial - space.middle) / space.half_width)  # type: ignore[operator, index]
    squashed = nn.Sequential(network, Squash(space))
    return TensorDictModule(squashed, in_keys=[base.OBSERVATION], out_keys=[base.ACTION])


class ExploringPolicy(TensorDictModuleBase):
    """The actor with Ornstein-Uhlenbeck noise for collection; without, where TorchRL's exploration type says so.

    Noise is drawn from torch's default generator, which the training loop seeds (in each worker process differently)
    and checkpoints. Each vehicle has a process of its own: an empty slot forgets.

    Args:
        actor: from :func:`make_actor`; shared, not copied.
        space: of the actions; with a point mass, actions around 0 count as 0: :attr:`no_op_band`. The replay stores the
            action itself, so that the critic's gradient leads out of the band.
        config: hyper-parameters.
    """

    noise_factor: Tensor
    uniform: Tensor

    def __init__(self, actor: TensorDictModule, space: ActionSpace, config: DDPGConfig) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [base.OBSERVATION, base.MASK], [base.ACTION]
        self.network = actor.module
        self.size = self.network[0][-1].out_features
        self.arrays = compiled_mlp.Arrays(self.network)
        self.low, self.high = float(space.low), float(space.high)
        self.theta, self.sigma = config.noise_theta, config.noise_sigma * (space.high - space.low)
        stationary = self.sigma / math.sqrt(max(1.0 - (1.0 - self.theta) ** 2, 1e-3))
        mass = space.point_mass
        self.no_op_band = 0.0 if mass is None else min(mass.band(stationary), 0.5 * self.high)
        # Buffers, so that collectors in other processes receive them with the weights.
        self.register_buffer("noise_factor", torch.tensor(1.0))
        self.register_buffer("uniform", torch.tensor(config.random_frames > 0))
        self.noise = torch.zeros(0)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write actions ``[*B, A, D]`` into ``tensordict``; the actor's are 0 in empty slots."""
        agents = tensordict.get("agents")
        mask = agents.get("mask")
        action = self.mean(agents.get("observation"), mask)
        if base.explores():
            action = self._explore(action, mask.unsqueeze(-1))
        agents._set_str("action", action, validated=True, inplace=False, non_blocking=False)  # its shape is right
        return tensordict

    def mean(self, observation: Tensor, mask: Tensor) -> Tensor:
        """Return the actor's actions ``[*B, A, D]``, compiled on the CPU where no gradient is asked for."""
        if self.size > 1 or not compiled_mlp.compilable(observation):
            return spread_out(self.network(observation[mask]), mask)
        out, network = np.empty(mask.numel(), np.float32), self.arrays.current()
        rows = observation.reshape(-1, observation.shape[-1]).numpy()
        slots = mask.reshape(-1, mask.shape[-1]).numpy().view(np.uint8)
        bounds = self.low, self.high
        compiled_mlp.for_all(
            len(slots), lambda envs: compiled_mlp.act_squashed(rows, slots, envs.start, envs.stop, network, bounds, out)
        )
        return torch.from_numpy(out).view(*mask.shape, 1)

    def _explore(self, action: Tensor, mask: Tensor) -> Tensor:
        if self.noise.shape != action.shape:
            self.noise = torch.zeros_like(action)
        self.noise.mul_(1.0 - self.theta).add_(torch.randn_like(action), alpha=self.sigma).masked_fill_(~mask, 0.0)
        if self.uniform:
            return self.low + (self.high - self.low) * torch.rand_like(action)
        return torch.addcmul(action, self.noise, self.noise_factor).clamp_(self.low, self.high)


class DDPG:
    """The algorithm: actor, critic, replay, optimiser and update; see :class:`izoo.algos.learners.base.Algorithm`.

    Args:
        config: hyper-parameters.
        features: length ``F`` of an observation.
        space: of its actions.
        device: where the networks and the replay live.
    """

    options: type[AlgoConfig] = DDPGConfig
    critic_name = "value"
    """What TorchRL's loss calls its critics."""
    gradient_steps = 0

    def __init__(
        self, config: DDPGConfig, features: int, space: ActionSpace, device: torch.device | str = "cpu"
    ) -> None:
        self.config, self.space = config, space
        self.actor = make_actor(features, space, config).to(device)
        self.policy = ExploringPolicy(self.actor, space, config).to(device)
        self.untrained_output = self.actor.module[0][-1].bias[0].item()
        self.loss = self.make_loss(features).to(device)
        self.loss.set_keys(priority=ERROR)
        self.target_update = SoftUpdate(self.loss, tau=config.tau)
        self.parameters = {
            "actor": list(self.loss.actor_network_params.values(True, True)),
            "critic": list(getattr(self.loss, f"{self.critic_name}_network_params").values(True, True)),
        }
        self.optimiser = torch.optim.Adam(
            [
                {"params": self.parameters["actor"], "lr": config.actor_lr},
                {"params": self.parameters["critic"], "lr": config.critic_lr},
            ],
            weight_decay=config.weight_decay,
            fused=True,
        )
        self.replay = Replay(
            config.replay_rows, config.minibatch_rows, config.priority_alpha, config.priority_beta, device
        )
        self.frames = self.frames_held = 0

    def make_critic(self, features: int) -> ValueOperator:
        """Return a network of action values, on flat rows."""
        network = ActionValue(features, self.space, self.config)
        return ValueOperator(network, in_keys=[base.OBSERVATION, base.ACTION], out_keys=[base.ACTION_VALUE])

    def make_loss(self, features: int) -> LossModule:
        """Return the loss of ``actor`` and a critic of its own."""
        self.critic = self.make_critic(features)
        return MaskedDDPGLoss(self.actor, self.critic, loss_function=self.config.value_loss, gamma=self.config.gamma)

    @property
    def policy_delay(self) -> int:
        """Gradient steps of the critic for each one of the actor and of the target networks."""
        return 1

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Store a batch ``[N, T]`` and learn from the replay; see :class:`izoo.algos.learners.base.Algorithm`."""
        self.frames += batch.numel()
        self.frames_held += batch.numel()
        share = self.config.rows_per_frame
        limit = None if share is None else math.ceil(share * batch.numel())
        self.replay.add(transitions(batch, self.config.reward_scale, self.config.n_step, self.config.gamma, limit))
        stats = {"replay_rows": float(len(self.replay)), "noise_factor": float(self.policy.noise_factor)}
        if self.frames_held >= self.config.learning_starts and len(self.replay) > 0:
            stats.update(self._learn(max(1, round(batch.numel() * self.config.updates_per_frame))))
        self._anneal(progress)
        return stats

    def _learn(self, steps: int) -> dict[str, float]:
        found: dict[str, list[Tensor]] = {}
        # Weights of idle units decay below 1e-38, and there a CPU is slow unless it takes them for 0.
        torch.set_flush_denormal(self.config.weight_decay > 0.0)
        try:
            for _ in range(steps):
                for key, value in self.gradient_step(self.replay.sample()).items():
                    found.setdefault(key, []).append(value)
        finally:
            torch.set_flush_denormal(False)
        return {key: float(torch.stack(values).mean()) for key, values in found.items()}

    def gradient_step(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        """Move the networks, then their targets, by one minibatch of transitions; returns what to log."""
        losses = self.loss(minibatch)
        self.optimiser.zero_grad()
        self.gradient_steps += 1
        moves_actor = self.gradient_steps % self.policy_delay == 0
        parts, moved = {"loss_value": losses[f"loss_{self.critic_name}"]}, ["critic"]
        if moves_actor:
            output = self.actor.module[0](minibatch.get(base.OBSERVATION))
            distance = (output - self.untrained_output).square().mean()
            parts |= {"loss_actor": losses["loss_actor"], "loss_saturation": self.config.saturation_coeff * distance}
            moved.append("actor")
        torch.stack(list(parts.values())).sum().backward()
        logged = {key: value.detach() for key, value in parts.items()}
        logged["value"] = losses["pred_value"].detach().mean()
        for name in moved:
            bound = self.config.max_grad_norm or math.inf
            logged[f"{name}_grad_norm"] = nn.utils.clip_grad_norm_(self.parameters[name], bound)
        self.optimiser.step()
        if moves_actor:
            self.target_update.step()
        self.replay.learned(minibatch)
        return logged

    def _anneal(self, progress: float) -> None:
        share = progress if self.config.noise_frames is None else self.frames / self.config.noise_frames
        self.policy.noise_factor.fill_(1.0 - (1.0 - self.config.noise_final) * min(share, 1.0))
        self.policy.uniform.fill_(self.frames < self.config.random_frames)

    def state_dict(self) -> dict[str, Any]:
        """Return weights, targets, optimiser state, exploration and, if asked for, the replay."""
        return {
            "policy": self.policy.state_dict(),
            "loss": dict(self.loss.state_dict()),
            "optimiser": self.optimiser.state_dict(),
            "noise": self.policy.noise.clone(),
            "frames": self.frames,
            "replay": self.replay.state_dict() if self.config.save_replay else {},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.policy.load_state_dict(state["policy"])
        self.loss.load_state_dict(state["loss"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.policy.noise = state["noise"].clone()  # the policy changes it in place
        self.frames = state["frames"]
        self.replay.load_state_dict(state["replay"])
        self.frames_held = self.frames if state["replay"] else 0
