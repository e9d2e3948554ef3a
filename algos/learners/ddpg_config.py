"""Hyper-parameters of DDPG and TD3, apart from them so that commands answer before PyTorch is loaded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from izoo.algos.learners.ppo_config import ACTIVATIONS, check_widths
from izoo.algos.learners.registry import AlgoConfig
from izoo.errors import check_choice, check_range, check_types


@dataclass(frozen=True)
class DDPGConfig(AlgoConfig):
    """Hyper-parameters of DDPG; the defaults are the preset ``tuned``.

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
            the later actions is small enough to go uncorrected).
        saturation_coeff: weight in the actor's loss of the squared distance, before the tanh, from the untrained output
            (RLlib, Lillicrap 0; arXiv 1707.01495, from 0 and with 1; ours 0.02). Without it a critic that is wrong at
            first drives the actor to full throttle everywhere, where the tanh has no gradient to bring it back.
        value_loss: ``l2`` (RLlib, Lillicrap) or ``smooth_l1`` (ours: bounded gradients).
        max_grad_norm: bound on each network's gradient; ``null`` for none (RLlib; ours 1).
        reward_scale: rewards are multiplied by it (RLlib 1; ours 0.1, so that values are of order 1).
        control_variate: ``vehicle``: from what a vehicle is paid is taken what the same vehicle is paid, from the same
            time on, in the uncommanded episode of the same context and seed, which is played beside the training: less
            variance, no bias (:func:`izoo.algos.learners.decisions.shaped`). Needs ``simulator=twin``. ``none``:
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
        initial_accel_mps2: acceleration of the untrained actor (RLlib: middle of the range, -0.95; ours 0.5). With
            ``action=advise`` or ``residual`` it does nothing at first instead.
        stores: what a transition holds as the action: ``commanded``, what the policy chose, or ``applied``, what came
            of it. The simulator's own driver may brake harder than a command asks, and then every such command does
            the same; ``applied`` stores the acceleration that the vehicle had, and of advice that changed nothing that
            none was given. With ``action=speed`` it is always what was chosen.
        save_replay: write the replay into checkpoints, so that a resumed run goes on exactly as it would have; without
            it checkpoints are small, and a resumed run collects ``learning_starts`` steps before it learns again.
    """

    name: Literal["ddpg"] = "ddpg"
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
    initial_accel_mps2: float = 0.5
    stores: Literal["commanded", "applied"] = "commanded"
    save_replay: bool = True

    def __post_init__(self) -> None:
        check_types("algo", self)
        for name in ("frames_per_batch", "minibatch_rows", "replay_rows", "n_step"):
            check_range(f"algo.{name}", getattr(self, name), 1, 10**9)
        for name in ("learning_starts", "random_frames"):
            check_range(f"algo.{name}", getattr(self, name), 0, 10**12)
        for name in ("priority_alpha", "priority_beta", "gamma", "noise_theta", "noise_final", "weight_decay"):
            check_range(f"algo.{name}", getattr(self, name), 0.0, 1.0)
        for name in ("updates_per_frame", "actor_lr", "critic_lr", "reward_scale"):
            check_range(f"algo.{name}", getattr(self, name), 1e-12, 100.0)
        check_range("algo.tau", self.tau, 1e-9, 0.5)
        for name in ("noise_sigma", "saturation_coeff"):
            check_range(f"algo.{name}", getattr(self, name), 0.0, 10.0)
        if self.max_grad_norm is not None:
            check_range("algo.max_grad_norm", self.max_grad_norm, 1e-9, 1e9)
        if self.rows_per_frame is not None:
            check_range("algo.rows_per_frame", self.rows_per_frame, 1e-3, 10**6)
        if self.noise_frames is not None:
            check_range("algo.noise_frames", self.noise_frames, 1, 10**12)
        check_choice("algo.activation", self.activation, ACTIVATIONS)
        check_widths("algo.hidden", self.hidden)

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
            initial_accel_mps2=-0.95,
        )


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

    name: Literal["td3"] = "td3"  # type: ignore[assignment]
    stores: Literal["commanded", "applied"] = "applied"
    policy_delay: int = 2
    target_noise: float = 0.2
    target_noise_clip: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("algo.policy_delay", self.policy_delay, 1, 10**6)
        for name in ("target_noise", "target_noise_clip"):
            check_range(f"algo.{name}", getattr(self, name), 0.0, 10.0)
