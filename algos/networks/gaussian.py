"""Tanh-squashed normal policies: what algorithms with a stochastic policy share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, TanhNormal

from izoo.algos.actions.action_modes import ActionSpace
from izoo.algos.learners import base
from izoo.algos.networks import compiled_mlp
from izoo.algos.networks.censored_normal import CensoredNormal
from izoo.errors import check_range

_LOG_2, _HALF_LOG_2_PI = math.log(2.0), 0.5 * math.log(2.0 * math.pi)


def normal_parameters(
    last: nn.Linear, space: ActionSpace, initial_accel_mps2: float | None, initial_spread: float
) -> NormalParamExtractor:
    """Return what turns a network's outputs, two for each number of an action, into median and spread before the tanh.

    Args:
        last: the network's last layer, with zero biases; its bias is set so that the untrained median is as wanted.
        space: of the actions; a point mass replaces the others, and the untrained median is then the action 0.
        initial_accel_mps2: median action of the untrained policy; ``None``: the middle of the range.
        initial_spread: its standard deviation before the tanh.
    """
    if space.point_mass is not None:
        return NormalParamExtractor(scale_mapping=f"biased_softplus_{space.point_mass.spread}", scale_lb=0.01)
    if initial_accel_mps2 is not None:
        check_range("algo.initial_accel_mps2", initial_accel_mps2, space.low + 1e-3, space.high - 1e-3, "m/s^2")
        low, high = space.low, space.high
        with torch.no_grad():
            last.bias[: last.out_features // 2] = math.atanh((2.0 * initial_accel_mps2 - high - low) / (high - low))
    return NormalParamExtractor(scale_mapping=f"biased_softplus_{initial_spread}", scale_lb=0.01)


class RangedTanhNormal(TanhNormal):
    """TorchRL's, with bounds that are made where its parameters are, so that CUDA graphs can hold it."""

    def __init__(self, loc: Tensor, scale: Tensor, low: float, high: float, **options: Any) -> None:
        super().__init__(loc, scale, low=loc.new_full((), low), high=loc.new_full((), high), **options)


def tanh_normal(network: nn.Module, in_keys: Sequence[tuple[str, ...]], space: ActionSpace) -> ProbabilisticActor:
    """Return the policy over actions in ``space`` whose ``(loc, scale)`` ``network`` returns."""
    point_mass = space.point_mass
    parameters = {"loc": base.LOC, "scale": base.SCALE}
    if point_mass is not None and point_mass.two_sided:
        parameters["two_sided"] = base.TWO_SIDED
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=list(in_keys), out_keys=[base.LOC, base.SCALE]),
        in_keys=parameters,
        out_keys=[base.ACTION],
        distribution_class=RangedTanhNormal if point_mass is None else CensoredNormal,
        distribution_kwargs={"low": space.low, "high": space.high}
        if point_mass is None
        else {"bound": space.high, "half_band": point_mass.half_band},
        return_log_prob=True,
        log_prob_key=base.LOG_PROB,
    )


class CommonNoise:
    """Noise of which all agents of an episode have a share in common, from its first step to its last.

    Agents that explore one by one do not find what pays only if most do it: a vehicle that glides alone holds up those
    behind it. What is common is drawn from the seed and the episode's number alone, so a run that is resumed goes on
    with it. A committed exploration of whole teams: Mahajan et al., arXiv 1910.07483.

    Args:
        share: of the variance, above 0, at most 1.
        seed: of what is common.
    """

    def __init__(self, share: float, seed: int) -> None:
        self.own, self.common, self.seed = math.sqrt(1.0 - share), math.sqrt(share), seed
        self._episodes: Sequence[int | None] = ()
        self._drawn = torch.zeros(0)

    def mix(self, noise: Tensor, episodes: Tensor) -> Tensor:
        """Return standard normal noise in the shape of ``noise``.

        Args:
            noise: ``[N, A]`` or ``[N, A, D]``, standard normal and independent.
            episodes: ``[N]`` number of each environment's episode.
        """
        now: list[int] = episodes.tolist()
        if len(now) != len(self._episodes):
            self._episodes, self._drawn = [None] * len(now), torch.zeros(len(now), 1, *noise.shape[2:])
        for env, (before, episode) in enumerate(zip(self._episodes, now, strict=True)):
            if episode != before:
                drawn = np.random.default_rng([self.seed, episode]).standard_normal(self._drawn[env].shape)
                self._drawn[env] = torch.from_numpy(drawn)
        self._episodes = now
        return self.own * noise + self.common * self._drawn.to(noise)


class SamplingPolicy(TensorDictModuleBase):
    """The policy of a :func:`tanh_normal` actor, for collection: same parameters and distribution, less overhead.

    Empty slots, where there is a mask, get ``loc`` 0, ``scale`` 1, action 0 and log-probability 0. It samples, or takes
    the median, as TorchRL's exploration type says.

    Args:
        actor: whose network is shared.
        space: of the actions.
    """

    no_op_band = 0.0
    """Actions smaller than this count as 0."""
    common_noise: CommonNoise | None = None
    """Where it is given, agents of an episode explore together; environments then emit its number."""

    def __init__(self, actor: ProbabilisticActor, space: ActionSpace) -> None:
        super().__init__()
        self.in_keys, self.size = [base.OBSERVATION], space.size
        self.half_band = -1.0 if space.point_mass is None else space.point_mass.half_band
        self.out_keys = [base.LOC, base.SCALE, base.ACTION, base.LOG_PROB]
        self.network = actor[0].module
        self.bounds = (float(space.low), float(space.high))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write loc, scale, action ``[*B, A, D]`` and log-probability ``[*B, A]`` into ``tensordict``."""
        agents = tensordict.get("agents")
        observation, mask = agents.get("observation"), agents.get("mask", None)
        if mask is None:
            mask = torch.ones(observation.shape[:-1], dtype=torch.bool, device=observation.device)
        shape = mask.shape if self.size == 1 else (*mask.shape, self.size)
        explores, episodes = base.explores(), tensordict.get(base.EPISODES, None)
        noise = (torch.randn if explores else torch.zeros)(shape, dtype=observation.dtype, device=observation.device)
        if self.common_noise is not None and explores and episodes is not None:
            noise = self.common_noise.mix(noise, episodes[..., 0])
        loc, scale, action, log_prob = self.sample(observation, mask, noise, agents.get("two_sided", None)).unbind(0)
        if self.size == 1:
            loc, scale, action = (part.unsqueeze(-1) for part in (loc, scale, action))
        else:
            log_prob = log_prob.sum(-1)
        for key, value in {"loc": loc, "scale": scale, "action": action, "action_log_prob": log_prob}.items():
            agents._set_str(key, value, validated=True, inplace=False, non_blocking=False)  # shapes are right
        return tensordict

    def sample(self, observation: Tensor, mask: Tensor, noise: Tensor, two_sided: Tensor | None = None) -> Tensor:
        """Return loc, scale, action and log-probability of each number of an action, ``[4, *noise.shape]``.

        Args:
            observation, mask: ``[*B, A, F]`` and ``[*B, A]``.
            noise: ``[*B, A]`` standard normal; for actions of several numbers ``[*B, A, D]``.
            two_sided: ``[*B, A]`` bool: actions below 0 differ from 0.
        """
        loc, scale = self.parameters_of(observation, mask)
        drawn = noise[mask].view(loc.shape)
        if self.half_band >= 0.0:
            sides = None if two_sided is None else two_sided[mask]
            distribution = CensoredNormal(loc, scale, self.bounds[1], self.half_band, sides)
            action = distribution.censor(torch.addcmul(loc, scale, drawn))
            sample = torch.stack((loc, scale, action, distribution.log_prob(action).unsqueeze(-1)))
        else:
            sample = squashed_sample(loc, scale, drawn, *self.bounds)
        padded = observation.new_zeros((4, *noise.shape))
        padded[1].fill_(1.0)
        padded[:, mask] = sample.reshape(4, -1, *noise.shape[mask.ndim :])
        return padded

    def parameters_of(self, observation: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return median and spread before the tanh, ``[n, D]`` each, of the ``n`` agents of ``[*B, A, F]``."""
        return self.network(observation[mask])


class CompiledPolicy(SamplingPolicy):
    """:class:`SamplingPolicy` of a fully connected network, compiled where it acts on the CPU without gradients."""

    def __init__(self, actor: ProbabilisticActor, space: ActionSpace) -> None:
        super().__init__(actor, space)
        self.arrays = compiled_mlp.Arrays(self.network)
        (extract,) = (module for module in self.network.modules() if isinstance(module, NormalParamExtractor))
        mapping = extract.scale_mapping
        spread = (float(mapping.bias), float(mapping.min_val), float(extract.scale_lb))
        self.squashing = compiled_mlp.Squashing(spread, self.bounds, self.half_band)

    def sample(self, observation: Tensor, mask: Tensor, noise: Tensor, two_sided: Tensor | None = None) -> Tensor:
        """Return loc, scale, action and log-probability, ``[4, *B, A]``; see :meth:`SamplingPolicy.sample`."""
        if self.size > 1 or not compiled_mlp.compilable(observation):
            return super().sample(observation, mask, noise, two_sided)
        flags = np.zeros(mask.numel(), np.uint8) if two_sided is None else two_sided.reshape(-1).numpy().view(np.uint8)
        out, network = np.empty((4, mask.numel()), np.float32), self.arrays.current()
        rows = observation.reshape(-1, observation.shape[-1]).numpy()
        slots, draws = mask.reshape(-1, mask.shape[-1]).numpy().view(np.uint8), noise.reshape(-1).numpy()
        compiled_mlp.for_all(
            len(slots),
            lambda envs: compiled_mlp.act(
                rows, slots, envs.start, envs.stop, network, self.squashing, flags, draws, out
            ),
        )
        return torch.from_numpy(out).view(4, *mask.shape)


def squashed_sample(loc: Tensor, scale: Tensor, noise: Tensor, low: float, high: float) -> Tensor:
    """Return ``loc``, ``scale``, the action ``tanh(loc + scale * noise)`` on ``[low, high]`` and its log-probability.

    All of one shape ``[*M]``; the result is ``[4, *M]``, and log-probabilities are those of single numbers.
    """
    half = (high - low) / 2
    raw = torch.addcmul(loc, scale, noise)
    # log(1 - tanh(x)^2) = 2 (log 2 - x - softplus(-2 x)), which does not lose precision far from 0.
    slope = 2.0 * (_LOG_2 - raw - nn.functional.softplus(-2.0 * raw))
    log_prob = -0.5 * noise.square() - scale.log() - slope - (_HALF_LOG_2_PI + math.log(half))
    return torch.stack([loc, scale, torch.tanh(raw) * half + (high + low) / 2, log_prob])
