"""Fully connected policies compiled for one step: a few dozen agents per call, or many shared out among threads.

It computes what the torch modules compute; at this size those spend most of their time on overhead. Each agent is
computed alone, so its action is the same to the last bit, whichever other agents there are.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from izoo.algos.learners.base import ACTIVATIONS
from izoo.algos.networks.censored_normal import MAX_EXCESS, STRONGEST
from izoo.compiling import compiled
from izoo.emissions.kernel import fast_tanh

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_MOST_EXCESS, _STRONGEST = MAX_EXCESS, STRONGEST


class Network(NamedTuple):
    """A fully connected network.

    Attributes:
        weights, biases: ``[O, I]`` and ``[O]`` of its layers, in the order in which they are applied.
        activation: between them; place in :data:`izoo.algos.learners.base.ACTIVATIONS`.
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    activation: int


class Squashing(NamedTuple):
    """How a network's two outputs become an action.

    With ``half_band`` of 0 or more, actions have a point mass at 0
    (:class:`izoo.algos.networks.censored_normal.CensoredNormal`).

    Attributes:
        spread: ``(offset, summand, floor)``: the spread is ``max(softplus(output + offset) + summand, floor)``.
        bounds: ``(low, high)`` of the action.
        half_band: half the width of the band that stands for the action 0; below 0: there is none.
    """

    spread: tuple[float, float, float]
    bounds: tuple[float, float]
    half_band: float


ShareOut = Callable[[Callable[[slice], object]], None]
"""Calls a task with each thread's share of the environments, all threads side by side."""
_THREADS: ContextVar[tuple[int, ShareOut] | None] = ContextVar("threads that act", default=None)


@contextlib.contextmanager
def acting_together(num_envs: int, share_out: ShareOut) -> Iterator[None]:
    """Let policies act for ``num_envs`` environments in the threads of ``share_out`` meanwhile."""
    token = _THREADS.set((num_envs, share_out))
    try:
        yield
    finally:
        _THREADS.reset(token)


def for_all(num_envs: int, task: Callable[[slice], object]) -> None:
    """Call ``task`` for so many environments: in the threads of :func:`acting_together`, or at once."""
    threads = _THREADS.get()
    if threads is not None and threads[0] == num_envs:
        threads[1](task)
    else:
        task(slice(0, num_envs))


class Arrays:
    """The linear layers of a network as arrays that share their memory, in the order in which they are applied.

    Args:
        network: of linear layers with one kind of activation.
    """

    def __init__(self, network: nn.Module) -> None:
        self.linears = [module for module in network.modules() if isinstance(module, nn.Linear)]
        places = {kind: place for place, kind in enumerate(ACTIVATIONS.values())}
        self.activation = next(places[type(module)] for module in network.modules() if type(module) in places)
        self._network = Network((), (), self.activation)
        self._places: list[int] = []

    def __getstate__(self) -> dict[str, Any]:
        # A copy's parameters may lie at addresses that held others before, so a copy begins without the arrays.
        return {**self.__dict__, "_network": Network((), (), self.activation), "_places": []}

    def current(self) -> Network:
        """Return the layers as they are now, even if they have moved in memory."""
        parameters = [layer._parameters for layer in self.linears]
        weights, biases = ([own[name] for own in parameters] for name in ("weight", "bias"))
        places = [parameter.data_ptr() for parameter in (*weights, *biases)]  # type: ignore[union-attr]
        if places != self._places:
            self._network = Network(_arrays(weights), _arrays(biases), self.activation)
            self._places = places
        return self._network


def _arrays(parameters: Sequence[nn.Parameter | None]) -> tuple[np.ndarray, ...]:
    return tuple(parameter.detach().numpy() for parameter in parameters)  # type: ignore[union-attr]


def compilable(observation: Tensor) -> bool:
    """Return whether the compiled policies can act on ``observation`` here: float32 on the CPU, without gradients."""
    return not torch.is_grad_enabled() and observation.device.type == "cpu" and observation.dtype == torch.float32


@compiled(error_model="numpy", fastmath={"reassoc", "contract"})
def linear(x, weight, bias):  # type: ignore[no-untyped-def]
    """Return ``x [n, I] @ weight.T [I, O] + bias [O]``; an agent's sums are added in the same order for any ``n``.

    Sums run along the inputs, eight or more at a time, so one agent alone is as fast per agent as many; four outputs at
    a time share what is read of the agent.
    """
    n, inputs = x.shape
    outputs = bias.shape[0]
    y = np.empty((n, outputs), np.float32)
    whole = outputs - outputs % 4
    for o in range(0, whole, 4):
        w0, w1, w2, w3 = weight[o], weight[o + 1], weight[o + 2], weight[o + 3]
        for j in range(n):
            own = x[j]
            s0, s1, s2, s3 = _ZERO, _ZERO, _ZERO, _ZERO
            for i in range(inputs):
                s0 += w0[i] * own[i]
                s1 += w1[i] * own[i]
                s2 += w2[i] * own[i]
                s3 += w3[i] * own[i]
            y[j, o], y[j, o + 1] = s0 + bias[o], s1 + bias[o + 1]
            y[j, o + 2], y[j, o + 3] = s2 + bias[o + 2], s3 + bias[o + 3]
    for o in range(whole, outputs):
        w = weight[o]
        for j in range(n):
            own = x[j]
            s = _ZERO
            for i in range(inputs):
                s += w[i] * own[i]
            y[j, o] = s + bias[o]
    return y


@compiled(error_model="numpy")
def activate(values, activation):  # type: ignore[no-untyped-def]
    """Apply the activation at this place of :data:`izoo.algos.learners.base.ACTIVATIONS` to ``values [m]`` in place."""
    if activation == 0:
        for k in range(values.shape[0]):
            values[k] = fast_tanh(values[k])
    elif activation == 1:
        for k in range(values.shape[0]):
            values[k] = max(values[k], _ZERO)
    else:
        for k in range(values.shape[0]):
            values[k] = values[k] / (_ONE + np.exp(-values[k]))


@compiled
def _softplus(x):  # type: ignore[no-untyped-def]
    return x + math.log1p(math.exp(-x)) if x > 0.0 else math.log1p(math.exp(x))


@compiled
def log_cdf(z):  # type: ignore[no-untyped-def]
    """Return the logarithm of the standard normal distribution function, precise in the lower tail."""
    if z > -30.0:
        return math.log(0.5 * math.erfc(-z / math.sqrt(2.0)))
    return -0.5 * z * z - math.log(-z) - 0.5 * math.log(2.0 * math.pi) + math.log1p(-1.0 / (z * z))


@compiled
def zero_log_prob(loc, scale, half_band, two_sided):  # type: ignore[no-untyped-def]
    """Return the log-probability of the action 0
    (:meth:`izoo.algos.networks.censored_normal.CensoredNormal.zero_log_prob`)."""
    if not two_sided:
        return log_cdf((half_band - loc) / scale)
    high, low = log_cdf((half_band - abs(loc)) / scale), log_cdf((-half_band - abs(loc)) / scale)
    return high + math.log1p(-math.exp(min(low - high, -1e-6)))


@compiled(error_model="numpy")
def outputs(x, network):  # type: ignore[no-untyped-def]
    """Return ``[n, O]``: a :class:`Network` on ``x [n, I]``."""
    for layer in range(len(network.weights)):
        x = linear(x, network.weights[layer], network.biases[layer])
        if layer < len(network.weights) - 1:
            activate(x.reshape(-1), network.activation)
    return x


@compiled(error_model="numpy")
def sample(parameters, rows, squashing, two_sided, noise, out):  # type: ignore[no-untyped-def]
    """Draw for the agents ``rows [r]``.

    Args:
        parameters: ``[r, 2]`` a network's outputs.
        rows: ``[r]`` their places among the ``n`` slots.
        squashing: a :class:`Squashing`.
        two_sided: ``[n]`` uint8: actions below 0 differ from 0.
        noise: ``[n]`` standard normal numbers.
        out: ``[4, n]`` outputs: median and spread before the tanh, action (0 beforehand), log-probability.
    """
    (offset, summand, floor), bounds, half_band = squashing
    middle, half = 0.5 * (bounds[0] + bounds[1]), 0.5 * (bounds[1] - bounds[0])
    constant = -0.5 * math.log(2.0 * math.pi) - 2.0 * math.log(2.0) - math.log(half)
    for j in range(rows.shape[0]):
        r = rows[j]
        scale = max(_softplus(parameters[j, 1] + offset) + summand, floor)
        z = noise[r]
        raw = parameters[j, 0] + scale * z
        out[0, r] = parameters[j, 0]
        out[1, r] = scale
        if half_band >= 0.0:
            excess = abs(raw) - half_band
            if excess <= 0.0 or (raw < 0.0 and not two_sided[r]):
                out[3, r] = zero_log_prob(float(parameters[j, 0]), scale, half_band, two_sided[r] != 0)
                continue
            if excess >= _MOST_EXCESS:
                out[2, r] = math.copysign(half * _STRONGEST, raw)
                beyond = (parameters[j, 0] if raw > 0.0 else -parameters[j, 0]) - (_MOST_EXCESS + half_band)
                out[3, r] = log_cdf(beyond / scale)
                continue
            out[2, r] = math.copysign(half * math.tanh(excess), raw)
            z = (math.copysign(excess + half_band, raw) - parameters[j, 0]) / scale
            raw = excess
        else:
            out[2, r] = middle + half * math.tanh(raw)
        # log(1 - tanh(x)^2) = 2 (log 2 - x - softplus(-2 x)), which does not lose precision far from 0.
        out[3, r] = constant - 0.5 * z * z - math.log(scale) + 2.0 * (raw + _softplus(-2.0 * raw))


@compiled(error_model="numpy", nogil=True)
def act(observation, mask, first, last, network, squashing, two_sided, noise, out):  # type: ignore[no-untyped-def]
    """Act for every agent by a fully connected network; what empty slots hold does not matter.

    These get median 0, spread 1, action 0 and log-probability 0.

    Args:
        observation: ``[n, F]``.
        mask: ``[M, A]``, ``n`` in all, uint8: the slot holds an agent.
        first, last: of the ``M`` environments those that are acted for.
        network: a :class:`Network` with two outputs.
        squashing, two_sided, noise, out: see :func:`sample`.
    """
    slots = mask.shape[1]
    rows = np.flatnonzero(mask[first:last]) + first * slots
    for k in range(4):
        out[k, first * slots : last * slots] = 1.0 if k == 1 else 0.0
    sample(outputs(observation[rows], network), rows, squashing, two_sided, noise, out)


@compiled(error_model="numpy", nogil=True)
def act_squashed(observation, mask, first, last, network, bounds, out):  # type: ignore[no-untyped-def]
    """Write ``tanh`` of a network's one output, on ``bounds``, to ``out [n]``; empty slots get 0; see :func:`act`."""
    slots = mask.shape[1]
    rows = np.flatnonzero(mask[first:last]) + first * slots
    raw = outputs(observation[rows], network)
    middle, half = 0.5 * (bounds[0] + bounds[1]), 0.5 * (bounds[1] - bounds[0])
    out[first * slots : last * slots] = 0.0
    for j in range(rows.shape[0]):
        out[rows[j]] = middle + half * math.tanh(raw[j, 0])
