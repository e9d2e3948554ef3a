"""Graph reinforcement learning: PPO on a graph of nearby controlled vehicles.

As in DGN (Jiang et al., arXiv 1810.09202): every vehicle encodes its observation, then multi-head dot-product attention
over itself and its neighbours convolves the encodings, layer by layer, with the same parameters for all; the head reads
the encodings of all layers, so ``layers`` bounds how many hops information travels. DGN learns values of discrete
actions and regularises attention over time for them; here actor and critic are two such networks, trained with PPO.

The graph follows from the observations: vehicles are as far apart as their signed distances to the stop line. That is
the distance along the road on one approach, the paper's setting. An observation does not say which approach its vehicle
is on, so with demand from several approaches, vehicles on others that are as far from the stop line count as near too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, ValueOperator

from izoo.algos import base
from izoo.algos.gaussian import SamplingPolicy, normal_parameters, tanh_normal
from izoo.algos.ppo import PPOConfig
from izoo.algos.sets import COLUMN, FRAME, RowView, SetPPO
from izoo.envs.layout import DISTANCE_SCALE_M, EGO_FEATURES
from izoo.errors import IzooError, check_range

STOP_LINE_DISTANCE = EGO_FEATURES.index("stop_line_distance")
"""Column of the observation that places a vehicle along its route."""


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
        """Return the preset ``paper``: the released code's settings, and RLlib 2.11's defaults where it has none."""
        return replace(
            cls(**vars(PPOConfig.paper()) | {"name": "gcrl"}),
            epochs=10,
            minibatch_rows=32,
            max_grad_norm=4.0,
            hidden=(64,),
            activation="relu",
            neighbours=None,
            range_m=None,
        )


def neighbourhood(position_m: Tensor, mask: Tensor, count: int | None, range_m: float | None) -> Tensor:
    """Return who attends to whom, ``[*M, A, A]`` bool: entry ``(i, j)`` says that ``j`` is ``i`` or its neighbour.

    Args:
        position_m: ``[*M, A]`` positions along the road; those of empty slots must be finite.
        mask: ``[*M, A]`` which slots hold an agent.
        count: the nearest so many are neighbours, and whoever is as near as the last of them, so that the order of the
            slots decides nothing; ``None`` for all.
        range_m: neighbours are at most so far away; ``None`` for any distance.
    """
    agents = mask.shape[-1]
    oneself = torch.eye(agents, dtype=torch.bool, device=mask.device)
    distance = (position_m.unsqueeze(-1) - position_m.unsqueeze(-2)).abs()
    other = (mask.unsqueeze(-1) & mask.unsqueeze(-2)) & ~oneself
    if range_m is not None:
        other = other & (distance <= range_m)
    if count is not None and count < agents - 1:
        distance = distance.masked_fill(~other, math.inf)
        limit = distance.kthvalue(count, dim=-1, keepdim=True).values if count else distance.new_tensor(-1.0)
        other = other & (distance <= limit)
    return other | oneself


class Convolution(nn.Module):
    """Multi-head attention of every agent over its neighbours and itself, then one layer.

    Args:
        width: of encodings before and after.
        heads: attention heads, which share the width.
        activation: one of :data:`izoo.algos.base.ACTIVATIONS`.
    """

    def __init__(self, width: int, heads: int, activation: str) -> None:
        super().__init__()
        self.heads = heads
        self.project = base.mlp(width, (), 3 * width, activation, last_gain=1.0)
        self.combine = nn.Sequential(
            base.mlp(width, (), width, activation, last_gain=2.0**0.5), base.ACTIVATIONS[activation]()
        )

    def forward(self, encoding: Tensor, attended: Tensor) -> Tensor:
        """Convolve ``encoding`` ``[*M, A, width]`` over the graph ``attended`` ``[*M, A, A]``."""
        parts = (
            self.project(encoding).unflatten(-1, (3, self.heads, -1)).transpose(-4, -2)
        )  # [*M, heads, 3, A, width/heads]
        query, key, value = parts.unbind(-3)
        mixed = nn.functional.scaled_dot_product_attention(query, key, value, attn_mask=attended.unsqueeze(-3))
        return self.combine(mixed.transpose(-3, -2).flatten(-2))


class GraphNetwork(nn.Module):
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
        encoder = base.mlp(features, hidden, width, activation, last_gain=2.0**0.5)
        self.encode = nn.Sequential(encoder, base.ACTIVATIONS[activation]())
        self.convolutions = nn.ModuleList(Convolution(width, config.heads, activation) for _ in range(config.layers))
        self.head = base.mlp((config.layers + 1) * width, (), outputs, activation, last_gain)

    def forward(self, observation: Tensor, mask: Tensor) -> Tensor:
        """Return ``[*M, A, outputs]``; empty slots hold finite numbers without meaning.

        Args:
            observation: ``[*M, A, F]``.
            mask: ``[*M, A]``.
        """
        observation = torch.where(mask.unsqueeze(-1), observation, torch.zeros_like(observation))
        position_m = observation[..., STOP_LINE_DISTANCE] * DISTANCE_SCALE_M
        attended = neighbourhood(position_m, mask, self.neighbours, self.range_m)
        encodings = [self.encode(observation)]
        for convolution in self.convolutions:
            encodings.append(convolution(encodings[-1], attended))
        return self.head(torch.cat(encodings, dim=-1))


class GraphActor(nn.Module):
    """Median and spread of every agent's acceleration before the tanh, ``[*M, A, 1]`` each, from the graph.

    Args:
        features: length ``F`` of an observation.
        low, high: bounds of the acceleration, m/s^2.
        config: hyper-parameters.
    """

    def __init__(self, features: int, low: float, high: float, config: GCRLConfig) -> None:
        super().__init__()
        self.graph = GraphNetwork(features, 2, config, last_gain=0.01)
        last = cast(nn.Linear, self.graph.head[-1])
        self.extract = normal_parameters(last, low, high, config.initial_accel_mps2, config.initial_spread)

    def forward(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return ``(loc, scale)`` of observations ``[*M, A, F]`` with ``mask`` ``[*M, A]``."""
        return self.extract(self.graph(observation, mask))


class GraphPolicy(SamplingPolicy):
    """The policy for collection; it acts on whole frames, so it reads the mask as well."""

    def __init__(self, actor: ProbabilisticActor, low: float, high: float) -> None:
        super().__init__(actor, low, high)
        self.in_keys = [base.OBSERVATION, base.MASK]

    def parameters_of(self, agents: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return median and spread before the tanh; slots beyond the last that is taken are left out of the graph."""
        observation, mask = agents.get("observation"), agents.get("mask")
        taken = mask.reshape(-1, mask.shape[-1]).any(0).nonzero()
        used = int(taken[-1]) + 1 if len(taken) else 1
        unused = (0, 0, 0, mask.shape[-1] - used)
        loc, scale = self.network.network(observation[..., :used, :], mask[..., :used])
        return nn.functional.pad(loc, unused), nn.functional.pad(scale, unused, value=1.0)


class GCRL(SetPPO):
    """PPO whose actor and critic are graph networks."""

    config: GCRLConfig

    def make_actor(self, features: int, low: float, high: float) -> ProbabilisticActor:
        """Return the policy on flat rows of whole frames."""
        network = RowView(GraphActor(features, low, high, self.config))
        return tanh_normal(network, [base.OBSERVATION, FRAME, COLUMN], low, high)

    def make_policy(self, low: float, high: float) -> SamplingPolicy:
        """Return the policy for collection; it shares the parameters of ``actor``."""
        return GraphPolicy(self.actor, low, high)

    def make_critic(self, features: int) -> ValueOperator:
        """Return the value function on flat rows of whole frames."""
        critic = RowView(GraphNetwork(features, 1, self.config, last_gain=1.0))
        return ValueOperator(critic, in_keys=[base.OBSERVATION, FRAME, COLUMN], out_keys=[base.VALUE])
