"""What algorithms have in common: the keys they read, network parts, and the interface that the training loop uses."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from izoo.errors import IzooError

OBSERVATION = ("agents", "observation")
MASK = ("agents", "mask")
DECIDES = ("agents", "decides")
"""``[*B, A]`` bool: agents whose action is a decision; absent where all agents decide (:func:`deciding`)."""
NUMBER = ("agents", "number")
"""``[*B, A]`` int64: the vehicle's number in the episode's demand."""
ACTION = ("agents", "action")
LOG_PROB = ("agents", "action_log_prob")
TWO_SIDED = ("agents", "two_sided")
"""``[*B, A]`` bool: agents whose actions below 0 differ from 0
(:class:`izoo.algos.networks.censored_normal.CensoredNormal`)."""
LOC, SCALE = ("agents", "loc"), ("agents", "scale")
VALUE, ADVANTAGE, VALUE_TARGET = ("agents", "state_value"), ("agents", "advantage"), ("agents", "value_target")
ACTION_VALUE = ("agents", "state_action_value")
POTENTIAL = ("agents", "potential")
"""``[*B, A, 1]``: the same vehicle's reward-to-go in the uncommanded episode
(:func:`izoo.algos.learners.decisions.shaped`)."""
EPISODES = "context_ids"
"""``[*B, 3]`` int64, in training on the twin: the number of the episode, the context's id or -1, the seed."""
REWARD, DONE, TERMINATED = ("agents", "reward"), ("agents", "done"), ("agents", "terminated")

ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU, "silu": nn.SiLU}

MOST_WEIGHTS = 10**8
"""Weights of a network, in all: 400 MB, and twice as much again for Adam."""
TYPICAL_FEATURES = 60


Keys = tuple[str | tuple[str, ...], ...]
"""Keys of a TensorDict."""


class Algorithm(Protocol):
    """The interface of an algorithm: the loop collects with ``policy`` and hands every batch to ``update``.

    One that also has ``reads``, of :data:`Keys`, learns from these keys of a batch alone, and others may be missing
    (:func:`reads`).
    """

    policy: TensorDictModuleBase

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Learn from a batch ``[N, T]`` of consecutive steps.

        Args:
            batch: what the collector gathered; ``N`` environments, ``T`` steps.
            progress: share of the run that is done, in [0, 1].

        Returns:
            Scalars to log, each over valid agent-steps alone.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return everything that learning needs to go on: tensors, numbers, strings and containers of them."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        ...


class AlgorithmWrapper:
    """An algorithm around another one, which holds all that is learned.

    Args:
        learned: the other one.
        policy: what acts; ``None``: the policy of ``learned``.
    """

    def __init__(self, learned: Algorithm, policy: TensorDictModuleBase | None = None) -> None:
        self.learned, self.policy = learned, learned.policy if policy is None else policy

    def state_dict(self) -> dict[str, Any]:
        """Return the learned algorithm's state."""
        return self.learned.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.learned.load_state_dict(state)


def innermost(wrapped: Any) -> Any:
    """Return the algorithm or the policy that learns, inside all wrappers."""
    while hasattr(wrapped, "learned"):
        wrapped = wrapped.learned
    return wrapped


def reads(algorithm: Algorithm) -> Keys | None:
    """Return the keys of a batch that an algorithm learns from; ``None``: any of them."""
    return getattr(algorithm, "reads", None)


def deciding(batch: TensorDictBase, mask: str | tuple[str, ...] = MASK) -> Any:
    """Return the agents that a batch ``[*B]`` is learned from, ``[*B, A]``: those that decide, or all that are present.

    Args:
        batch: of single steps, or of whole decisions (:class:`izoo.algos.learners.decisions.Decisions`).
        mask: key of the agents that are present; ``None`` is returned where it is missing.
    """
    there, decides = batch.get(mask, None), batch.get(DECIDES, None)
    return there if decides is None or there is None else there & decides


def explores() -> bool:
    """Return whether TorchRL's exploration type asks policies to draw their actions."""
    return exploration_type() not in (ExplorationType.DETERMINISTIC, ExplorationType.MODE, ExplorationType.MEAN)


def check_widths(option: str, widths: Sequence[int]) -> None:
    """Raise :class:`IzooError` unless these are widths of hidden layers that fit into a memory."""
    if not widths or min(widths) < 1:
        raise IzooError(f"{option} is {list(widths)}; it needs one or more positive widths, like [128,128].")
    weights = sum(before * after for before, after in itertools.pairwise((TYPICAL_FEATURES, *widths)))
    if weights > MOST_WEIGHTS:
        raise IzooError(f"{option} is {list(widths)}: {weights:,} weights, more than {MOST_WEIGHTS:,}; give fewer.")


class Standardise(nn.Module):
    """Observations minus their mean, divided by their spread; as they are until :meth:`measure` has seen some.

    Args:
        features: length ``F`` of an observation.
    """

    LIMIT = 5.0
    """No standardised value is larger."""
    mean: Tensor
    spread: Tensor
    measured: Tensor

    def __init__(self, features: int) -> None:
        super().__init__()
        for name, value in (("mean", torch.zeros(features)), ("spread", torch.ones(features))):
            self.register_buffer(name, value)
        self.register_buffer("measured", torch.tensor(False))

    def forward(self, observation: Tensor) -> Tensor:
        """Return ``[*B, F]`` of ``[*B, F]``."""
        standard = ((observation - self.mean) / self.spread).clamp(-self.LIMIT, self.LIMIT)
        return torch.where(self.measured, standard, observation)

    def measure(self, observation: Tensor) -> None:
        """Take mean and spread from the first rows ``[n, F]`` that are given; constant features keep their spread."""
        if not self.measured and len(observation) > 1:
            spread, mean = torch.std_mean(observation, 0)
            self.mean.copy_(mean)
            self.spread.copy_(torch.where(spread > 1e-4, spread, 1.0))
            self.measured.fill_(True)


def mlp(
    inputs: int, hidden: Sequence[int], outputs: int, activation: str, last_gain: float, standardise: bool = False
) -> nn.Sequential:
    """Return a fully connected network with orthogonal weights and zero biases.

    Args:
        inputs, hidden, outputs: widths.
        activation: one of :data:`ACTIVATIONS`.
        last_gain: gain of the last layer; small values make the initial output nearly independent of the input.
        standardise: begin with :class:`Standardise`.
    """
    layers: list[nn.Module] = [Standardise(inputs)] if standardise else []
    widths = [inputs, *hidden]
    for before, after in itertools.pairwise(widths):
        linear = nn.Linear(before, after)
        nn.init.orthogonal_(linear.weight, gain=2.0**0.5)
        nn.init.zeros_(linear.bias)
        layers += [linear, ACTIVATIONS[activation]()]
    last = nn.Linear(widths[-1], outputs)
    nn.init.orthogonal_(last.weight, gain=last_gain)
    nn.init.zeros_(last.bias)
    return nn.Sequential(*layers, last)


def next_values(values: Tensor, boundary: Tensor, boundary_values: Tensor) -> Tensor:
    """Return the value of each step's successor.

    The successor of a step is the same slot one step later, so only the steps of ``boundary`` (the end of the batch,
    or of an agent's life) need a value of their own.

    Args:
        values: ``[N, T, A, 1]`` values of the observations.
        boundary: ``[N, T, A]`` bool, steps whose successor is not the next entry of the batch.
        boundary_values: ``[boundary.sum(), 1]`` their successors' values.
    """
    shifted = torch.zeros_like(values)
    shifted[:, :-1] = values[:, 1:]
    shifted[boundary] = boundary_values
    return shifted
