"""CMA-ES over the settings of ``glide``: how a rule should drive, found by the returns of whole teams.

The rule knows what to look at: when the signal turns, how long the queue ahead is, how slow to drive to arrive then.
How slow is too slow, how long a queue takes, and where holding back pays at all, it does not know, and the answers
differ between roads of one lane and of several, where others overtake. So each of the two has numbers of its own, and a
search of its own, told by the contexts of its kind.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from izoo.algos.actions.action_modes import ActionSpace, DirectAction
from izoo.algos.drivers.base import DEFER
from izoo.algos.drivers.glide import Glide
from izoo.algos.drivers.observed import Observed
from izoo.algos.learners import base
from izoo.algos.learners.cmaes import CMAES, CMAESConfig, acting_parameters
from izoo.algos.learners.registry import ON_TWIN
from izoo.envs import COMPILED
from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, BY_STEP, EnvConfig
from izoo.envs.mdp.reward import RewardConfig
from izoo.errors import IzooError

KINDS = ("one lane", "several lanes")
"""Kinds of roads with numbers of their own."""
KIND = "road_kind"
"""Key ``[*B, 1]`` int8: of which of :data:`KINDS` the context is; -1 where there is no CV."""


@dataclass(frozen=True)
class GlideSearchConfig(CMAESConfig):
    """Hyper-parameters of CMA-ES over the settings of glide, one set for roads of one lane and one for several.

    Attributes:
        name: the algorithm.
        population: rules of a generation, each of which plays the same contexts and seeds (arXiv 1604.00772: 4 + 3 ln
            n, which is 13 for 23 numbers; ours 16). It divides ``num_envs``.
        initial_spread: standard deviation of the first generation's numbers (ours 0.5: settings differ by a sixth).
        most_difference: as for CMA-ES (ours a tenth).
    """

    name: str = "glide_search"
    initial_spread: float = 0.5
    most_difference: float | None = 0.1
    needs_env: ClassVar[bool] = True
    runs: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "teams": {
            **ON_TWIN,
            "action": DirectAction(),
            "env": {
                **BY_STEP,
                "hold_s": 2.0,
                "num_agents": 64,
                "num_vehicles": 192,
                "horizon_s": 600.0,
                "reward": dataclasses.replace(RewardConfig.fuel_team(), delay=-0.2),
                "neighbours": ("leader", "follower"),
                "observed": ("adoption", "green_s", "red_s", "lane_count", "lane_length_m", "speed_limit_mps"),
            },
            "twin": {"surrogate": "compiled", "compare_every": 0, "stagger": False},
            "num_envs": 512,
            "total_frames": 3_072_000,
            "validation": {"every_batches": 5, "contexts": 48, "seeds": 3, "simulator": COMPILED},
            "evaluation": {"contexts": 16, "seeds": 3},
        }
    }


@dataclass(frozen=True)
class Searched:
    """A setting of glide that is searched.

    Attributes:
        name: of :class:`~izoo.algos.drivers.glide.GlideConfig`.
        starts: where the search begins, by kind of road.
        unit: what 1 stands for: of the setting, or, with ``ratio``, of its logarithm.
        ratio: the setting is its start times a factor, and so stays above 0.
    """

    name: str
    starts: tuple[float, float]
    unit: float = 0.35
    ratio: bool = True

    def value(self, number: Tensor, several: Tensor) -> Tensor:
        """Return the setting that a number of the search stands for, on roads of several lanes or of one."""
        one, more = self.starts
        start = torch.where(several, more, one)
        return start * torch.exp(self.unit * number.clamp(-6.0, 6.0)) if self.ratio else start + self.unit * number


SETTINGS = (
    Searched("start_lag_s", (2.5, 2.0)),
    Searched("headway_s", (2.4, 2.2)),
    Searched("spacing_m", (7.5, 7.5)),
    Searched("moving_fill", (0.1, 0.07)),
    Searched("margin_s", (0.0, 0.0), 2.0, ratio=False),
    Searched("late_s", (2.0, 2.0)),
    Searched("floor_mps", (4.0, 6.0)),
    Searched("near_m", (20.0, 30.0)),
    Searched("headway_gap_s", (1.5, 2.2)),
    Searched("response_s", (2.0, 2.0)),
    Searched("brake_mps2", (1.0, 0.7)),
    Searched("push_mps2", (1.0, 1.0)),
    Searched("stop_decel_mps2", (0.3, 0.3)),
    Searched("stop_margin", (1.4, 1.6)),
)
"""Glide's settings, and where the search begins: by hand, on measured intersections (one setting at a time)."""
OTHERS = {"standing_gap_m": 3.0, "queue_speed_mps": 2.0}
GATE = ("always", "green share", "seconds to lose", "distance", "follower", "more lanes", "adoption", "traffic", "red")
"""What decides whether holding back is worth it: a CV glides where the weighted sum of these is above 0."""
GATE_STARTS = ((1.0, 0.5, 0.0, 0.0, 0.0, 0.0, -1.5, 0.5, 0.0), (0.3, 0.5, 0.0, 0.0, 0.0, -0.2, -1.0, 0.5, 0.0))
"""Weights at the start of the search, by kind of road."""
FOLLOWER_M = 60.0
LATE_S = 1.0
"""A vehicle that would reach the line later than this after the end of green does not pass: some pass on yellow."""
YELLOW_MPS2 = 3.0
"""On yellow, a vehicle that can stop with this deceleration does."""
NEEDED = ("follower_present", "context_adoption", "context_lane_length_m")
"""What the search looks at besides what glide does."""


class SearchedGlide(Glide):
    """Glide with settings that are tensors, and a gate in the place of its limits on lanes and green.

    Where the gate is closed, CVs that must stop brake early and gently, as with glide; so do those that would arrive
    after the present green, and those that follow closely.

    Args:
        config: settings of the environment; :data:`NEEDED` must be observed besides what glide needs.
    """

    gate: Tensor
    environments: Tensor
    followers_stop = True

    def __init__(self, config: EnvConfig) -> None:
        super().__init__(config)
        self.seen = Observed(config, NEEDED, "algo=glide_search")
        self.shortest_response_s = config.decision_s

    def drive_with(self, numbers: Tensor, observation: Tensor, environments: Tensor) -> tuple[Tensor, Tensor]:
        """Return accelerations in m/s^2, and which CVs are left alone, ``[M]`` each.

        Args:
            numbers: ``[M or 1, kinds, n]``.
            observation: ``[M, F]``, of CVs alone.
            environments: ``[M]`` which environment each of them is in.
        """
        several = self.lanes(observation) > 1.5
        one, more = numbers[:, 0], numbers[:, 1]
        chosen = torch.where(several.unsqueeze(-1), more, one)
        values = {setting.name: setting.value(chosen[..., k], several) for k, setting in enumerate(SETTINGS)}
        values["response_s"] = values["response_s"].clamp_min(self.shortest_response_s)
        values["floor_mps"] = values["floor_mps"].clamp_min(0.1)
        rule: Any = copy.copy(self)  # the rule itself stays as it is, and so does its fingerprint
        rule.settings, rule.response_s = SimpleNamespace(**values, **OTHERS), values["response_s"]
        rule.environments = environments
        starts = chosen.new_tensor(GATE_STARTS)
        rule.gate = chosen[..., len(SETTINGS) :] + torch.where(several.unsqueeze(-1), starts[1], starts[0])
        accel, defer = rule.drive(observation, torch.ones_like(several))
        return accel.clamp(ACTION_LOW_MPS2, ACTION_HIGH_MPS2), defer

    def lanes(self, observation: Tensor) -> Tensor:
        """Return how many lanes each CV's approach has, in the shape of ``observation`` without its last dimension."""
        return self.seen(observation, "context_lane_count")

    def gliding_pays(self, observation: Tensor) -> Tensor:
        """Return where the gate is open, ``[M]``."""
        green = self.seen(observation, "context_green_s")
        red = self.seen(observation, "context_red_s")
        limit = self.seen(observation, "context_speed_limit_mps").clamp_min(1.0)
        distance = -self.seen(observation, "stop_line_distance")
        free_s = distance / limit
        lost_s = (self.passing_time(observation, distance, free_s) - free_s).clamp(0.0, 60.0)
        follower = self.seen(observation, "follower_distance") < FOLLOWER_M
        features = (
            torch.ones_like(distance),
            4.0 * (green / (green + red).clamp_min(1.0) - 0.3),
            lost_s / 10.0 - 1.0,
            distance / 150.0 - 1.0,
            follower.float() - 0.5,
            (self.lanes(observation) - 2.5) / 1.5,
            3.0 * (self.seen(observation, "context_adoption") - 1.0 / 3.0),
            self.traffic(observation) / 3.0 - 1.0,
            red / 30.0 - 1.0,
        )
        return (torch.stack(features, -1) * self.gate).sum(-1) > 0.0

    def stop_is_certain(self, observation: Tensor, distance: Tensor, ahead: Tensor, speed: Tensor) -> Tensor:
        """Return whether the present red, or the end of the present green, keeps each CV from passing, ``[M]``."""
        red = self.seen.flag(observation, "signal_red")
        green = self.seen.flag(observation, "signal_green")
        left = self.seen(observation, "signal_time_left")
        limit = self.seen(observation, "context_speed_limit_mps").clamp_min(1.0)
        too_late = green & (distance / torch.maximum(limit, speed) > left + LATE_S)
        yellow = ~red & ~green & (distance > 0.5 * speed**2 / YELLOW_MPS2)
        return super().stop_is_certain(observation, distance, ahead, speed) | too_late | yellow

    def traffic(self, observation: Tensor) -> Tensor:
        """Return how many vehicles there are per lane and 100 m of each CV's approach, ``[M]``, at most 12.

        They are not observed, but the CVs are: as many times as many as one in how many vehicles is one. CVs are taken
        to be on the same approach where length, limit and lanes of theirs are the same.
        """
        names = ("context_lane_length_m", "context_speed_limit_mps", "context_lane_count")
        approach = torch.stack([self.seen(observation, name) for name in names], -1)
        places = torch.cat([self.environments.unsqueeze(-1).to(approach.dtype), approach], -1)
        approaches, own = places.unique(dim=0, return_inverse=True)
        comes = self.seen.flag(observation, "location_approaching")
        count = approach.new_zeros(len(approaches)).index_add_(0, own[comes], approach.new_ones(int(comes.sum())))
        length_m = self.seen(observation, "context_lane_length_m")
        share = self.seen(observation, "context_adoption")
        road = (share * self.lanes(observation) * length_m / 100.0).clamp_min(1e-3)
        return (count[own] / road).clamp_max(12.0)


class GlidePolicies(TensorDictModuleBase):
    """A population of searched rules while exploring in training mode, and their mean otherwise.

    Args:
        config: settings of the environment.
        population: how many.
    """

    mean: Tensor
    candidates: Tensor
    no_op_band = 0.0
    kinds = len(KINDS)
    reads: base.Keys = (KIND,)

    def __init__(self, config: EnvConfig, population: int) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [base.OBSERVATION, base.MASK], [base.ACTION, DEFER, KIND]
        self.rule = SearchedGlide(config)
        width = len(SETTINGS) + len(GATE)
        self.register_buffer("mean", torch.zeros(self.kinds, width))
        self.register_buffer("candidates", torch.zeros(population, self.kinds, width))

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write actions ``[*B, A, 1]``, 0 in empty slots, ``defer`` ``[*B, A]``, and :data:`KIND`.

        Raises:
            IzooError: while exploring, the environments cannot be shared out evenly.
        """
        seen, mask = tensordict.get(base.OBSERVATION), tensordict.get(base.MASK)
        numbers = acting_parameters(self, mask)
        accel, defer = torch.zeros(mask.shape), torch.ones_like(mask)
        if mask.any():
            # Most slots are empty, and the rule takes a hundred operations.
            environments = mask.view(-1, mask.shape[-1]).nonzero()[:, 0]
            own = numbers if len(numbers) == 1 else numbers[environments]
            accel[mask], defer[mask] = self.rule.drive_with(own, seen[mask], environments)
        lanes = torch.where(mask, self.rule.lanes(seen), 0.0).amax(-1, keepdim=True)
        tensordict.set(KIND, torch.where(lanes > 0.5, (lanes > 1.5).to(torch.int8), -1))
        return tensordict.set(base.ACTION, accel.unsqueeze(-1)).set(DEFER, defer)

    def kind_of(self, batch: TensorDictBase) -> Tensor:
        """Return of which of :data:`KINDS` each context of a batch ``[N, T]`` is, ``[N]``; -1 where no CV came."""
        return batch.get(KIND).squeeze(-1).amax(1)


class GlideSearch(CMAES):
    """CMA-ES over the settings of glide; see :class:`izoo.algos.learners.cmaes.CMAES`.

    Args:
        config: hyper-parameters.
        features: not needed: the rule reads columns by name.
        space: accelerations without a point mass: the rule itself says when to leave a CV alone.
        device: where the numbers live.
        env: settings of the environment.

    Raises:
        IzooError: an action mode was chosen that makes commands of something else.
    """

    options = GlideSearchConfig

    config: GlideSearchConfig

    def __init__(
        self,
        config: GlideSearchConfig,
        features: int,
        space: ActionSpace,
        device: torch.device | str = "cpu",
        *,
        env: EnvConfig,
    ) -> None:
        if space.point_mass is not None or (space.low, space.high) != (ACTION_LOW_MPS2, ACTION_HIGH_MPS2):
            raise IzooError(
                "algo=glide_search commands accelerations and knows when to leave a CV alone; choose action=direct, "
                "without a range of your own."
            )
        self._start(config, GlidePolicies(env, config.population).to(device))
