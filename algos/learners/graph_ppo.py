"""Graph reinforcement learning: PPO on a graph of nearby controlled vehicles.

As in DGN (Jiang et al., arXiv 1810.09202): every vehicle encodes its observation, then multi-head dot-product attention
over itself and its neighbours convolves the encodings, layer by layer, with the same parameters for all; the head reads
the encodings of all layers, so ``layers`` bounds how many hops information travels. DGN learns values of discrete
actions and regularises attention over time for them; here actor and critic are two such networks, trained with PPO.

The graph follows from the observations alone: vehicles are as far apart as their signed distances to the stop line.
Where demand enters from one approach, which is the paper's setting, that is the distance along the road up to the line;
beyond it, vehicles that left by different exits count as near when they are equally far from the junction. With demand
from all approaches, vehicles on different ones count as near too, and can take the places of nearer ones on the own
road among the ``neighbours``: nothing observed says which approach a vehicle is on. Equal signal clocks do not prove
one approach, since opposite approaches share phases; unequal ones prove two only for equal intentions, so a rule made
of them would cut some of the wrong pairs and keep as many. What tells roads apart as far as it can be told (signal
clock, intention, lane, location, context features) is in the encodings that the attention weighs. ``neighbours=null``
makes everyone within ``range_m`` a neighbour, so that no vehicle on the own road is crowded out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, ValueOperator

from izoo.algos.actions.action_modes import ActionSpace
from izoo.algos.learners import base
from izoo.algos.learners.ppo import PPOConfig
from izoo.algos.learners.set_ppo import SetPPO
from izoo.algos.losses import MaskedGraphPPOLoss
from izoo.algos.networks.gaussian import SamplingPolicy, normal_parameters, tanh_normal
from izoo.algos.networks.set_networks import COLUMN, FRAME, RowView, SetNetwork, Sets, places
from izoo.envs.mdp.observation import DISTANCE_SCALE_M, EGO_FEATURES
from izoo.errors import IzooError

STOP_LINE_DISTANCE = EGO_FEATURES.index("stop_line_distance")
"""Column of the observation that places a vehicle along its route."""
REACH = ("agents", "reach_m")
"""Key of how far away a row's neighbours may be, m."""
ROW = [base.OBSERVATION, FRAME, COLUMN, REACH]
BIN_ROWS = 16
"""Fewest rows of a set that attention works on, where there are that many; larger sets pad more, smaller ones cost more
calls."""


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

    name: str = "gcrl"
    starts_with = "graph"
    neighbours: int | None = 4
    range_m: float | None = 100.0
    layers: int = 2
    heads: int = 4
    ranges = (("neighbours", 0, 4096), ("range_m", 0.0, 1e6, "m"), ("layers heads", 1, 4096))

    def __post_init__(self) -> None:
        super().__post_init__()
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
            super().paper(),
            epochs=10,
            max_grad_norm=4.0,
            hidden=(64,),
            activation="relu",
            neighbours=None,
            range_m=None,
        )


def reach_m(position_m: Tensor, others: Tensor, count: int | None, range_m: float | None) -> Tensor:
    """Return how far away the last neighbour of each agent may be, ``[*M, A]``; below 0, it has none.

    Args:
        position_m: ``[*M, A]`` positions along the road; all must be finite.
        others: ``[*M, A, A]`` bool: entry ``(i, j)`` says that ``j`` could be a neighbour of ``i``.
        count: the nearest so many are neighbours, and all that are as near as the last of them, so that the order of
            the slots decides nothing; ``None`` for all.
        range_m: neighbours are at most so far away; ``None`` for any distance.
    """
    bound = torch.finfo(position_m.dtype).max if range_m is None else range_m
    if count is None or count == 0:
        return torch.full_like(position_m, bound if count is None else -1.0)
    distance = (position_m.unsqueeze(-1) - position_m.unsqueeze(-2)).abs().masked_fill(~others, math.inf)
    return distance.kthvalue(min(count, distance.shape[-1]), dim=-1).values.clamp(max=bound)


class Bins(Sets):
    """Whole frames side by side in sets of about one size, so attention within frames of any size pads little.

    Args:
        frame, column: ``[n]`` places of the rows, as for :class:`izoo.algos.networks.set_networks.SetNetwork`.
    """

    def __init__(self, frame: Tensor, column: Tensor) -> None:
        sizes = torch.bincount(frame).tolist()
        width = max([min(BIN_ROWS, len(frame)), 1, *sizes])
        starts, end = [], 0
        for size in sizes:
            if end % width + size > width:
                end += width - end % width
            starts.append(end)
            end += size
        super().__init__(frame.new_tensor(starts)[frame] + column, (max(-(-end // width), 1), width))
        self.frame = self.pack(frame + 1)

    def others(self) -> Tensor:
        """Return ``[K, W, W]`` bool: entry ``(i, j)`` says that ``j`` is another agent of the frame of ``i``."""
        together = (self.frame.unsqueeze(-1) == self.frame.unsqueeze(-2)) & (self.frame > 0).unsqueeze(-1)
        return together & ~torch.eye(self.shape[1], dtype=torch.bool, device=self.frame.device)


def neighbourhood(position_m: Tensor, others: Tensor, reach: Tensor) -> Tensor:
    """Return the attention mask ``[*M, A, A]`` bool: entry ``(i, j)`` says that ``j`` is ``i`` or its neighbour.

    The arguments are those of :func:`reach_m`, and what it returned.
    """
    distance = (position_m.unsqueeze(-1) - position_m.unsqueeze(-2)).abs()
    near = others & (distance <= reach.unsqueeze(-1))
    return near | torch.eye(near.shape[-1], dtype=torch.bool, device=near.device)


class Convolution(nn.Module):
    """Multi-head attention of every agent over its neighbours and itself, then one layer.

    Args:
        width: of encodings before and after.
        heads: attention heads, which share the width.
        activation: one of :data:`izoo.algos.learners.base.ACTIVATIONS`.
    """

    def __init__(self, width: int, heads: int, activation: str) -> None:
        super().__init__()
        self.heads = heads
        self.project = base.mlp(width, (), 3 * width, activation, last_gain=1.0)
        self.combine = nn.Sequential(
            base.mlp(width, (), width, activation, last_gain=2.0**0.5), base.ACTIVATIONS[activation]()
        )

    def forward(self, encoding: Tensor, bins: Bins, unattended: Tensor) -> Tensor:
        """Convolve the rows ``encoding`` ``[n, width]``.

        Args:
            encoding: of all agents.
            bins: which of them are together.
            unattended: ``[K, W, W]``: 0 where ``i`` attends to ``j``, minus infinity elsewhere.
        """
        sets, agents = bins.shape
        parts = bins.pack(self.project(encoding)).view(sets, agents, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        query, key, value = parts.reshape(3, sets * self.heads, agents, -1).unbind(0)
        penalty = unattended.unsqueeze(1).expand(-1, self.heads, -1, -1).reshape(-1, agents, agents)
        scores = torch.baddbmm(penalty, query, key.mT, alpha=query.shape[-1] ** -0.5)
        mixed = (scores.softmax(-1) @ value).unflatten(0, (sets, self.heads)).transpose(1, 2).flatten(-2)
        return self.combine(bins.unpack(mixed))


class GraphNetwork(SetNetwork):
    """Encoder, convolutions and a head that reads the encodings of all layers.

    Args:
        features: length ``F`` of an observation.
        outputs: how many numbers the head returns per agent.
        config: widths and graph.
        last_gain: gain of the head's weights.
    """

    def __init__(self, features: int, outputs: int, config: GCRLConfig, last_gain: float) -> None:
        super().__init__()
        self.neighbours, self.range_m = config.neighbours, config.range_m
        (*hidden, width), activation = config.hidden, config.activation
        encoder = base.mlp(features, hidden, width, activation, 2.0**0.5, config.standardise)
        self.encode = nn.Sequential(encoder, base.ACTIVATIONS[activation]())
        self.convolutions = nn.ModuleList(Convolution(width, config.heads, activation) for _ in range(config.layers))
        self.head = base.mlp((config.layers + 1) * width, (), outputs, activation, last_gain)

    def rows(self, observation: Tensor, frame: Tensor, column: Tensor, reach: Tensor | None = None) -> Tensor:
        """Return ``[n, outputs]``.

        Args:
            observation, frame, column: see :class:`izoo.algos.networks.set_networks.SetNetwork`.
            reach: ``[n]`` from :func:`reach_m`, where it is known.
        """
        bins = Bins(frame, column)
        position_m, others = bins.pack(positions_m(observation)), bins.others()
        reach = reach_m(position_m, others, self.neighbours, self.range_m) if reach is None else bins.pack(reach)
        attended = neighbourhood(position_m, others, reach)
        unattended = torch.zeros_like(attended, dtype=observation.dtype).masked_fill(~attended, -math.inf)
        encodings = [self.encode(observation)]
        for convolution in self.convolutions:
            encodings.append(convolution(encodings[-1], bins, unattended))
        return self.head(torch.cat(encodings, dim=-1))


def positions_m(observation: Tensor) -> Tensor:
    """Return the positions ``[*M]`` along the road that observations ``[*M, F]`` tell."""
    return observation[..., STOP_LINE_DISTANCE] * DISTANCE_SCALE_M


class GraphActor(SetNetwork):
    """Median and spread of every agent's action before the tanh, ``[n, D]`` each, from the graph.

    Args:
        features: length ``F`` of an observation.
        space: of the actions.
        config: hyper-parameters.
    """

    def __init__(self, features: int, space: ActionSpace, config: GCRLConfig) -> None:
        super().__init__()
        self.graph = GraphNetwork(features, 2 * space.size, config, last_gain=0.01)
        last = cast(nn.Linear, self.graph.head[-1])
        self.extract = normal_parameters(last, space, config.initial_accel_mps2, config.initial_spread)

    def rows(
        self, observation: Tensor, frame: Tensor, column: Tensor, reach: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return ``(loc, scale)``; see :meth:`GraphNetwork.rows`."""
        return self.extract(self.graph.rows(observation, frame, column, reach))


class GraphPolicy(SamplingPolicy):
    """The policy for collection; it acts on whole frames, so it needs the mask."""

    def __init__(self, actor: ProbabilisticActor, space: ActionSpace) -> None:
        super().__init__(actor, space)
        self.in_keys = [base.OBSERVATION, base.MASK]

    def parameters_of(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return median and spread before the tanh, ``[n, D]`` each, of the ``n`` agents of ``[*B, A, F]``."""
        return self.network(observation[mask], *places(mask))


class GCRL(SetPPO):
    """PPO whose actor and critic are graph networks."""

    options = GCRLConfig
    config: GCRLConfig

    def make_actor(self, features: int) -> ProbabilisticActor:
        """Return the policy on flat rows of whole frames."""
        return tanh_normal(RowView(GraphActor(features, self.space, self.config)), ROW, self.space)

    def make_policy(self) -> SamplingPolicy:
        """Return the policy for collection; it shares the parameters of ``actor``."""
        return GraphPolicy(self.actor, self.space)

    def make_critic(self, features: int) -> ValueOperator:
        """Return the value function on flat rows of whole frames."""
        critic = RowView(GraphNetwork(features, 1, self.config, last_gain=1.0))
        return ValueOperator(critic, in_keys=ROW, out_keys=[base.VALUE])

    def make_loss(self) -> MaskedGraphPPOLoss:
        """Return the loss of ``actor`` and ``critic``."""
        return MaskedGraphPPOLoss(self.actor, self.critic, **self.loss_options())

    @torch.no_grad()
    def advantages(self, batch: TensorDictBase) -> TensorDict:
        """Estimate advantages and flatten; each row also remembers its reach, since the graph does not learn."""
        rows = super().advantages(batch)
        bins = Bins(rows.get(FRAME), rows.get(COLUMN))
        position_m = bins.pack(positions_m(rows.get(base.OBSERVATION)))
        reach = reach_m(position_m, bins.others(), self.config.neighbours, self.config.range_m)
        return rows.set(REACH, bins.unpack(reach))
