"""Tanh-squashed normal policies over accelerations: parts that algorithms with a stochastic policy share."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import ProbabilisticActor, TanhNormal

from izoo.algos import base
from izoo.errors import check_range

_LOG_2, _HALF_LOG_2_PI = math.log(2.0), 0.5 * math.log(2.0 * math.pi)


def normal_parameters(
    last: nn.Linear, low: float, high: float, initial_accel_mps2: float, initial_spread: float
) -> NormalParamExtractor:
    """Return what turns the two outputs of a network into median and spread before the tanh.

    Args:
        last: the network's last layer, with zero biases; its bias is set so that the untrained median is as wanted.
        low, high: bounds of the acceleration, m/s^2.
        initial_accel_mps2: median acceleration of the untrained policy.
        initial_spread: its standard deviation before the tanh.
    """
    check_range("algo.initial_accel_mps2", initial_accel_mps2, low + 1e-3, high - 1e-3, "m/s^2")
    with torch.no_grad():
        last.bias[0] = math.atanh((2.0 * initial_accel_mps2 - high - low) / (high - low))
    return NormalParamExtractor(scale_mapping=f"biased_softplus_{initial_spread}", scale_lb=0.01)


def tanh_normal(network: nn.Module, in_keys: Sequence[tuple[str, ...]], low: float, high: float) -> ProbabilisticActor:
    """Return the policy over accelerations in ``[low, high]`` m/s^2 whose ``(loc, scale)`` ``network`` returns."""
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=list(in_keys), out_keys=[base.LOC, base.SCALE]),
        in_keys={"loc": base.LOC, "scale": base.SCALE},
        out_keys=[base.ACTION],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": low, "high": high},
        return_log_prob=True,
        log_prob_key=base.LOG_PROB,
    )


class SamplingPolicy(TensorDictModuleBase):
    """The policy of a :func:`tanh_normal` actor, for collection: same parameters and distribution, less overhead.

    Building distribution objects costs more than the network at a few dozen rows. It samples, or takes the median where
    TorchRL's exploration type says so.

    Args:
        actor: whose network is shared.
        low, high: bounds of the acceleration, m/s^2.
    """

    def __init__(self, actor: ProbabilisticActor, low: float, high: float) -> None:
        super().__init__()
        self.in_keys = [base.OBSERVATION]
        self.out_keys = [base.LOC, base.SCALE, base.ACTION, base.LOG_PROB]
        self.network = actor[0].module
        self.middle, self.half = (high + low) / 2, (high - low) / 2

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write loc, scale, action ``[*B, A, 1]`` and log-probability ``[*B, A]`` into ``tensordict``."""
        agents = tensordict.get("agents")
        loc, scale = self.parameters_of(agents)
        if exploration_type() in (ExplorationType.DETERMINISTIC, ExplorationType.MODE, ExplorationType.MEAN):
            raw = loc
        else:
            raw = torch.addcmul(loc, scale, torch.randn_like(loc))
        # log(1 - tanh(x)^2) = 2 (log 2 - x - softplus(-2 x)), which does not lose precision far from 0.
        slope = 2.0 * (_LOG_2 - raw - nn.functional.softplus(-2.0 * raw))
        log_prob = -0.5 * ((raw - loc) / scale).square() - scale.log() - slope - (_HALF_LOG_2_PI + math.log(self.half))
        agents.set("loc", loc)
        agents.set("scale", scale)
        agents.set("action", torch.tanh(raw).mul_(self.half).add_(self.middle))
        agents.set("action_log_prob", log_prob.squeeze(-1))
        return tensordict

    def parameters_of(self, agents: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return median and spread before the tanh, ``[*B, A, 1]`` each, of the group ``agents`` ``[*B, A]``."""
        return self.network(agents.get("observation"))
