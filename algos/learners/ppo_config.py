"""Hyper-parameters of PPO and of what is built on it: MAPPO and graph RL.

They are apart from the algorithms so that commands answer before PyTorch is loaded.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from izoo.algos.actions.action_modes import SPREADS
from izoo.algos.learners.registry import AlgoConfig
from izoo.errors import IzooError, check_range, check_types

ACTIVATIONS = ("tanh", "relu", "silu")
"""Names of the activations that networks may have."""

MOST_WEIGHTS = 10**8
"""Weights of a network, in all: 400 MB, and twice as much again for Adam."""
TYPICAL_FEATURES = 60


def check_widths(option: str, widths: Sequence[int]) -> None:
    """Raise :class:`IzooError` unless these are widths of hidden layers that fit into a memory."""
    if not widths or min(widths) < 1:
        raise IzooError(f"{option} is {list(widths)}; it needs one or more positive widths, like [128,128].")
    weights = sum(before * after for before, after in itertools.pairwise((TYPICAL_FEATURES, *widths)))
    if weights > MOST_WEIGHTS:
        raise IzooError(f"{option} is {list(widths)}: {weights:,} weights, more than {MOST_WEIGHTS:,}; give fewer.")


@dataclass(frozen=True)
class PPOConfig(AlgoConfig):
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
        control_variate: ``vehicle``: from what a vehicle is paid is taken what the same vehicle is paid, from the same
            time on, in the uncommanded episode of the same context and seed, which is played beside the training: less
            variance, no bias (:func:`izoo.algos.learners.decisions.shaped`). Needs ``simulator=twin``. ``none``:
            nothing (ours).
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
        initial_accel_mps2: median acceleration of the untrained policy. Vehicles that hardly accelerate block the road,
            and vehicles at full throttle learn slowly to do less (RLlib: middle of the range, -0.95; ours 0.5). With
            ``action=advise`` or ``residual`` it does nothing at first instead.
        initial_spread: standard deviation of the untrained policy before the tanh (RLlib 1; ours 0.35, about 1 m/s^2).
            With ``action=advise`` or ``residual`` it is ``action.spread`` instead.
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
    warm_start: Literal["none", "glide"] = "none"
    warm_start_frames: int = 100_000
    warm_start_lr: float | None = None
    kl_to_start: float = 1.0
    standardise: bool = False
    hidden: tuple[int, ...] = (128, 128)
    activation: Literal["tanh", "relu", "silu"] = "tanh"
    initial_accel_mps2: float = 0.5
    initial_spread: float = 0.35

    def __post_init__(self) -> None:
        check_types("algo", self)
        for name in ("frames_per_batch", "epochs", "minibatch_rows"):
            check_range(f"algo.{name}", getattr(self, name), 1, 10**9)
        if self.rows_per_epoch is not None:
            check_range("algo.rows_per_epoch", self.rows_per_epoch, 1, 10**9)
        if self.target_kl is not None:
            check_range("algo.target_kl", self.target_kl, 1e-6, 100.0)
        for name in ("gamma", "gae_lambda"):
            check_range(f"algo.{name}", getattr(self, name), 0.0, 1.0)
        for name in ("lr", "reward_scale", "kl_target"):
            check_range(f"algo.{name}", getattr(self, name), 1e-12, 100.0)
        check_range("algo.clip_epsilon", self.clip_epsilon, 1e-12, 0.999)
        check_range("algo.initial_spread", self.initial_spread, *SPREADS)
        for name in ("value_coeff", "entropy_coeff", "kl_coeff"):
            check_range(f"algo.{name}", getattr(self, name), 0.0, 1e6)
        for name in ("max_grad_norm", "value_error_clip"):
            if getattr(self, name) is not None:
                check_range(f"algo.{name}", getattr(self, name), 1e-9, 1e9)
        check_range("algo.warm_start_frames", self.warm_start_frames, 1, 10**12)
        if self.warm_start_lr is not None:
            check_range("algo.warm_start_lr", self.warm_start_lr, 1e-12, 100.0)
        check_range("algo.kl_to_start", self.kl_to_start, 0.0, 1e6)
        check_widths("algo.hidden", self.hidden)

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


@dataclass(frozen=True)
class MAPPOConfig(PPOConfig):
    """Hyper-parameters of MAPPO: those of PPO, and of the critic over the set.

    The paper names MAPPO but trains it with the defaults of RLlib 2.11, which has no such algorithm; the example it
    ships (``rllib/examples/centralized_critic.py``) is PPO with another critic, for two agents. So the preset ``paper``
    is PPO's, with the set critic as here.

    Attributes:
        name: the algorithm.
        credit: ``agent``: every CV's advantage is estimated from its own rewards, which end when it leaves; ``team``:
            one is estimated from the team's rewards, which go on, and shared by all CVs. ``team`` needs a reward that
            is the team's: ``env.reward=fuel_team``, or ``env.reward.eta=1``.
        critic_sees: ``cvs``: the critic sees the CVs, each as it observes; ``all``: also, from above, every vehicle of
            the region while training (:mod:`izoo.algos.networks.fleet_features`). The policy sees neither.
        control_variate: ``team`` takes from the team's reward what it was at the same time of the uncommanded episode
            of the same context and seed, which says how busy it is there just then, whatever the CVs do; that goes with
            ``credit=team``, and ``vehicle``, as for PPO, with ``credit=agent``.
        critic_queries: learned queries, each of which gathers its own summary of the set (Lee et al. use 1 where one
            output is wanted; ours 4: one mean for each of several kinds of vehicle, such as queued and arriving).
        critic_embedding: width of a vehicle's embedding and of the summary (Lee et al. 128; ours the same).
    """

    name: Literal["mappo"] = "mappo"  # type: ignore[assignment]
    credit: Literal["agent", "team"] = "agent"
    critic_sees: Literal["cvs", "all"] = "cvs"
    control_variate: Literal["none", "vehicle", "team"] = "none"  # type: ignore[assignment]
    critic_queries: int = 4
    critic_embedding: int = 128

    def __post_init__(self) -> None:
        super().__post_init__()
        fitting = "team" if self.credit == "team" else "vehicle"
        if self.control_variate not in ("none", fitting):
            raise IzooError(
                f"algo.control_variate={self.control_variate} does not go with the returns of algo.credit="
                f"{self.credit}; choose {fitting} or none."
            )
        check_range("algo.critic_queries", self.critic_queries, 1, 64)
        check_range("algo.critic_embedding", self.critic_embedding, 1, 4096)

    @classmethod
    def paper(cls) -> MAPPOConfig:
        """Return the preset ``paper``: RLlib 2.11's defaults of PPO, and the critic as here."""
        return cls(**vars(PPOConfig.paper()) | {"name": "mappo"})


@dataclass(frozen=True)
class GCRLConfig(PPOConfig):
    """Hyper-parameters of graph RL: those of PPO, and of the graph network.

    Sources: "DGN" is arXiv 1810.09202, appendix; "released" is the IntersectionZoo code's ``ppo_gat_training.py``,
    whose settings the preset ``paper`` takes. (There the nodes of a graph are the rows of a minibatch, whatever step or
    episode they stem from, and actor and critic share the network; here nodes are the vehicles of one step, and actor
    and critic share nothing.)

    Attributes:
        name: the algorithm.
        neighbours: how many of the nearest vehicles are neighbours, ties included; ``null``: all (DGN 3; released: all;
            ours 4).
        range_m: vehicles farther away than this are no neighbours; ``null``: any distance (DGN and released: none; ours
            100, the order of the distances over which one driver's speed reaches those behind).
        layers: convolutions (DGN 2; released 2; ours 2).
        heads: attention heads per convolution (DGN 8; released 4; ours 4).
        hidden: widths of the encoder's layers; the last is also that of every convolution, shared among its heads (DGN
            512, 128; released 64, where each head is that wide; ours 128, 128).
    """

    name: Literal["gcrl"] = "gcrl"  # type: ignore[assignment]
    neighbours: int | None = 4
    range_m: float | None = 100.0
    layers: int = 2
    heads: int = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.neighbours is not None:
            check_range("algo.neighbours", self.neighbours, 0, 4096)
        if self.range_m is not None:
            check_range("algo.range_m", self.range_m, 0.0, 1e6, "m")
        for name in ("layers", "heads"):
            check_range(f"algo.{name}", getattr(self, name), 1, 4096)
        if self.hidden[-1] % self.heads:
            raise IzooError(
                f"the last of algo.hidden={list(self.hidden)} must be a multiple of algo.heads={self.heads}: the heads "
                "share it."
            )

    @classmethod
    def paper(cls) -> GCRLConfig:
        """Return the preset ``paper``: the released code's settings, and RLlib 2.11's defaults where it has none.

        The code also asks for minibatches of 32 rows, by an option (``mini_batch_size_per_learner``) of RLlib's new API
        stack alone, while its model (``TorchModelV2``) runs on the old one: there they stay at 128.
        """
        return replace(
            cls(**vars(PPOConfig.paper()) | {"name": "gcrl"}),
            epochs=10,
            max_grad_norm=4.0,
            hidden=(64,),
            activation="relu",
            neighbours=None,
            range_m=None,
        )
