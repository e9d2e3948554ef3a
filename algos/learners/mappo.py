"""Multi-agent PPO: PPO's decentralised policy, and a critic that sees all controlled vehicles while learning.

The critic works on the *set* of controlled vehicles (Yu et al., arXiv 2103.01955, with sets instead of concatenated
observations): any number of them, in any order. A vehicle's value is a function of its own embedding and of one summary
of the set, shared by all, which learned queries gather by masked attention (pooling by multi-head attention, Lee et
al., arXiv 1810.00825). Keeping the own embedding matters, since vehicles leave at different times and, with
``reward.eta`` below 1, have different rewards; one summary per set keeps the cost linear in the number of vehicles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.modules import ValueOperator

from izoo.algos.learners import base
from izoo.algos.learners.ppo import PPOConfig
from izoo.algos.learners.set_ppo import SetPPO
from izoo.algos.losses import MaskedMAPPOLoss
from izoo.algos.losses.masked_gae import TEAM_REWARD
from izoo.algos.networks.fleet_features import FLEET, FLEET_WIDTH, add_fleet
from izoo.algos.networks.set_networks import COLUMN, FRAME, RowView, SetNetwork, Sets, spread_out
from izoo.errors import IzooError

TEAM_BASELINE = "team_baseline"
"""Key of the control variate ``[*B, T, 1]`` under ``"next"``: see :meth:`MAPPO.advantages`."""
COUNT_SCALE = 10.0
"""The number of agents enters the critic divided by this."""


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

    name: str = "mappo"
    credit: Literal["agent", "team"] = "agent"
    critic_sees: Literal["cvs", "all"] = "cvs"
    control_variate: Literal["none", "vehicle", "team"] = "none"  # type: ignore[assignment]
    critic_queries: int = 4
    critic_embedding: int = 128
    ranges = (("critic_queries", 1, 64), ("critic_embedding", 1, 4096))

    def __post_init__(self) -> None:
        super().__post_init__()
        fitting = "team" if self.credit == "team" else "vehicle"
        if self.control_variate not in ("none", fitting):
            raise IzooError(
                f"algo.control_variate={self.control_variate} does not go with the returns of algo.credit="
                f"{self.credit}; choose {fitting} or none."
            )

    @property
    def emits(self) -> tuple[str, ...]:
        """Groups that the environment has to emit for this algorithm."""
        team = ("team_reward",) if self.credit == "team" else ()
        return (*team, *super().emits, *(("vehicles",) if self.critic_sees == "all" else ()))

    def by_step(self, run: Any) -> tuple[str, ...]:
        """Return the options with which it learns from decisions in every step alone."""
        return ("algo.credit=team",) if self.credit == "team" else ()

    def check_run(self, run: Any) -> None:
        """Raise :class:`IzooError` where other options of a run do not go with these."""
        super().check_run(run)
        if self.credit == "team" and run.env.reward.eta != 1.0:
            raise IzooError(
                f"algo.credit=team estimates one advantage for the whole team, but env.reward.eta is "
                f"{run.env.reward.eta:g}: CVs are paid differently. Choose env.reward=fuel_team or env.reward.eta=1, "
                "or algo.credit=agent."
            )


class SetCritic(SetNetwork):
    """Values of agents that form a set.

    Args:
        features: length ``F`` of an observation.
        config: widths.
    """

    def __init__(self, features: int, config: MAPPOConfig) -> None:
        super().__init__()
        width, queries = config.critic_embedding, config.critic_queries
        activation = base.ACTIVATIONS[config.activation]
        self.embed = nn.Sequential(
            base.mlp(features, config.hidden[:-1], width, config.activation, 2.0**0.5, config.standardise), activation()
        )
        self.score = base.mlp(width, (), queries, config.activation, last_gain=1.0)
        self.gather = nn.Sequential(
            base.mlp(queries * width, (), width, config.activation, last_gain=2.0**0.5), activation()
        )
        fleet = FLEET_WIDTH if config.critic_sees == "all" else 0
        self.value = base.mlp(2 * width + 1 + fleet, config.hidden[-1:], 1, config.activation, last_gain=1.0)

    def rows(self, observation: Tensor, frame: Tensor, column: Tensor, fleet: Tensor | None = None) -> Tensor:
        """Return values ``[n, 1]``; see :class:`izoo.algos.networks.set_networks.SetNetwork`.

        Args:
            observation, frame, column: as there.
            fleet: ``[n, FLEET_WIDTH]`` the picture of all vehicles of a row's frame, where the critic sees them.
        """
        sets, own = Sets.frames(frame, column), self.embed(observation)
        mask = sets.pack(torch.ones_like(frame, dtype=torch.bool))
        summary = self.gather(self.attend(sets.pack(own), mask).flatten(-2))
        count = mask.sum(-1, keepdim=True).to(own.dtype) / COUNT_SCALE
        shared = torch.cat([summary, count], dim=-1).index_select(0, frame)
        return self.value(torch.cat([own, shared, *([] if fleet is None else [fleet])], dim=-1))

    def attend(self, own: Tensor, mask: Tensor) -> Tensor:
        """Return the queries' weighted means ``[*M, queries, width]`` of embeddings ``[*M, A, width]``.

        Empty slots weigh nothing; an empty set gives 0.
        """
        scores = self.score(own).masked_fill(~mask.unsqueeze(-1), torch.finfo(own.dtype).min)
        weights = torch.where(mask.unsqueeze(-1), scores.softmax(dim=-2), torch.zeros_like(scores))
        return weights.transpose(-2, -1) @ own


class TeamCritic(SetCritic):
    """One value for all agents that form a set; a set without agents has one as well.

    Args:
        features: length ``F`` of an observation.
        config: widths.
    """

    def __init__(self, features: int, config: MAPPOConfig) -> None:
        super().__init__(features, config)
        inputs = config.critic_embedding + 1 + (FLEET_WIDTH if config.critic_sees == "all" else 0)
        self.value = base.mlp(inputs, config.hidden[-1:], 1, config.activation, last_gain=1.0)

    def forward(self, observation: Tensor, mask: Tensor, fleet: Tensor | None = None) -> Tensor:
        """Return values ``[*M, 1]`` of frames ``[*M, A, F]`` with ``mask`` ``[*M, A]``.

        Args:
            observation, mask: of the CVs.
            fleet: ``[*M, A, FLEET_WIDTH]`` the picture of all vehicles, the same in all slots; the first is read.
        """
        own = spread_out(self.embed(observation[mask]), mask)
        count = mask.sum(-1, keepdim=True).to(own.dtype) / COUNT_SCALE
        seen = [] if fleet is None else [fleet[..., 0, :]]
        return self.value(torch.cat([self.gather(self.attend(own, mask).flatten(-2)), count, *seen], dim=-1))


class MAPPO(SetPPO):
    """PPO with a centralised critic; the policy needs one agent's observation alone."""

    options = MAPPOConfig
    config: MAPPOConfig

    def make_critic(self, features: int) -> ValueOperator:
        """Return the value function of the set: of each agent, or of the team."""
        fleet = [FLEET] if self.config.critic_sees == "all" else []
        if self.config.credit == "team":
            team = TeamCritic(features, self.config)
            return ValueOperator(team, in_keys=[base.OBSERVATION, base.MASK, *fleet], out_keys=[base.VALUE])
        critic = RowView(SetCritic(features, self.config))
        return ValueOperator(critic, in_keys=[base.OBSERVATION, FRAME, COLUMN, *fleet], out_keys=[base.VALUE])

    def make_loss(self) -> MaskedMAPPOLoss:
        """Return the loss of ``actor`` and ``critic``."""
        return MaskedMAPPOLoss(self.actor, self.critic, team=self.config.credit == "team", **self.loss_options())

    @torch.no_grad()
    def advantages(self, batch: TensorDictBase) -> TensorDict:
        """Estimate advantages and flatten, as PPO does; with a ``control_variate`` of the team's differences.

        Then ``("next", "team_baseline")``, the team's reward at the same time of the uncommanded episode of the
        same context and seed, is taken from the team's reward. This biases no gradient. The uncommanded episode is
        decided by context and seed alone, so its rewards ``b`` are the same whatever is done here; nor can an action
        decide how many of them are summed, since the team's return ends with the episode and not with a vehicle. Given
        the state and the seed, the sum of future ``b`` is thus a constant, and the mean over actions of a constant
        times the gradient of their log-probability is 0: a baseline that depends on the input (Mao et al., arXiv
        1807.02264). The critic learns the value of the difference; with ``gae_lambda`` below 1 estimates are biased
        by its errors, no otherwise than without.
        """
        batch = batch.copy()
        if self.config.critic_sees == "all":
            add_fleet(batch)
        if self.config.control_variate == "team":
            key = ("next", TEAM_REWARD)
            batch.set(key, batch.get(key) - batch.get(("next", TEAM_BASELINE)))
        return super().advantages(batch)
