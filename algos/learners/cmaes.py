"""CMA-ES over linear policies: no gradients, no credit to assign, whole episodes compared with each other.

The policies of a generation play the same contexts with the same seeds (common random numbers), so they differ by their
driving and not by the traffic that they met: differences that policy gradients lose in the noise of single actions show
in the returns of whole teams. A return belongs to a whole fleet, so a vehicle's effect on those behind it counts.

The strategy is Hansen's (arXiv 1604.00772), by the library ``cma``; linear policies for control by random search:
Mania et al., arXiv 1803.07055.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import cma
import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from izoo.algos.actions.action_modes import ActionSpace, AdviseAction
from izoo.algos.learners import base
from izoo.algos.learners.registry import ON_TWIN, AlgoConfig
from izoo.algos.losses.masked_gae import TEAM_REWARD
from izoo.envs import COMPILED
from izoo.envs.config import BY_STEP
from izoo.envs.mdp.reward import RewardConfig
from izoo.errors import IzooError

MOST = 2.0
"""Observations are cut off here: some count far away as very large."""
FULL = 3.0
"""Of this the tanh is 0.995."""


@dataclass(frozen=True)
class CMAESConfig(AlgoConfig):
    """Hyper-parameters of the evolution strategy CMA-ES over linear policies.

    Sources: "Hansen" is arXiv 1604.00772; "Mania" is arXiv 1803.07055, which found linear policies enough for
    locomotion; "ours" was chosen by short runs.

    Attributes:
        name: the algorithm.
        population: policies of a generation, each of which plays the same contexts and seeds (Hansen: 4 + 3 ln n, which
            is 14 for 30 numbers; ours 16). It divides ``num_envs``, and the quotient is how many contexts they play.
        initial_spread: standard deviation of the first generation's weights (ours 0.3: observations are of order 1, so
            that some of these policies do something and few do much).
        most_difference: a policy's return in one context differs from the generation's mean there by no more than this
            share of it, so that a few contexts that jam do not decide alone; null: no bound.
    """

    name: str = "cmaes"
    population: int = 16
    initial_spread: float = 0.3
    most_difference: float | None = None
    frames_per_batch: ClassVar[int] = 1  # type: ignore[misc]  # no option: a batch is an episode of each environment
    runs: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "teams": {
            **ON_TWIN,
            "action": AdviseAction(),
            "env": {
                **BY_STEP,
                "hold_s": 2.0,
                "reward": RewardConfig.fuel_team(),
                "neighbours": ("leader",),
                "observed": ("green_s", "red_s", "speed_limit_mps"),
            },
            "num_envs": 256,
            "total_frames": 1_990_000,
            "validation": {"every_batches": 4, "contexts": 16, "seeds": 3, "simulator": COMPILED},
        }
    }

    ranges = (("population", 4, 4096), ("initial_spread most_difference", 1e-6, 100.0))

    @classmethod
    def teams(cls) -> CMAESConfig:
        """Return the preset ``teams``: advice every 2 s from a few observations, whole teams compared."""
        return cls()

    @property
    def candidates(self) -> int:
        """How many policies are compared in each batch."""
        return self.population


class LinearPolicies(TensorDictModuleBase):
    """A population of linear policies while exploring in training mode, and their mean otherwise.

    Environments are shared out among the policies in equal blocks, in order. An agent's action is a tanh of
    ``x = weights . observation + bias``, stretched to the bounds. With a ``band``, every ``x`` within it stands for the
    action 0, which leaves the vehicle alone, and so do weights of 0; without one, weights of 0 ask for full throttle,
    which the simulator's own driver bounds.

    Args:
        features: length ``F`` of an observation.
        space: of the actions.
        population: policies, of ``F + 1`` weights each.
        band: see above; ``None``: there is none.
    """

    mean: Tensor
    candidates: Tensor
    no_op_band = 0.0
    kinds = 1
    reads: base.Keys = ()
    """What :meth:`kind_of` looks at."""

    def __init__(self, features: int, space: ActionSpace, population: int, band: float | None) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [base.OBSERVATION, base.MASK], [base.ACTION]
        self.middle, self.half, self.band = space.middle, space.half_width, band
        self.register_buffer("mean", torch.zeros(features + 1))
        self.register_buffer("candidates", torch.zeros(population, features + 1))

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write actions ``[*B, A, 1]``, 0 in empty slots.

        Raises:
            IzooError: while exploring, the environments cannot be shared out evenly.
        """
        seen, mask = tensordict.get(base.OBSERVATION).clamp(-MOST, MOST), tensordict.get(base.MASK)
        weights = acting_parameters(self, mask)
        raw = torch.matmul(seen, weights[:, :-1, None]).squeeze(-1) + weights[:, -1:]
        raw = raw.view(mask.shape)
        raw = raw + FULL if self.band is None else raw.sign() * (raw.abs() - self.band).clamp_min(0.0)
        action = self.middle + self.half * torch.tanh(raw)
        return tensordict.set(base.ACTION, torch.where(mask, action, 0.0).unsqueeze(-1))

    def kind_of(self, batch: TensorDictBase) -> Tensor:
        """Return zeros ``[N]``: all contexts are of one kind."""
        return torch.zeros(batch.shape[0], dtype=torch.int64)


def acting_parameters(policies: Any, mask: Tensor) -> Tensor:
    """Return the parameters that act in each environment, ``[N, ...]``: the candidates' while exploring, or the mean's.

    Args:
        policies: a module with ``candidates`` ``[P, ...]`` and ``mean`` ``[...]``.
        mask: ``[N, A]`` or ``[A]``; the environments are shared out among the candidates in equal blocks, in order.

    Raises:
        IzooError: they cannot be shared out evenly.
    """
    if not (policies.training and base.explores()):
        return policies.mean.unsqueeze(0)
    count, envs = len(policies.candidates), mask.shape[0] if mask.ndim > 1 else 1
    if mask.ndim < 2 or envs % count:
        raise IzooError(f"{count} policies cannot share {envs} environments evenly; give a multiple of {count}.")
    return policies.candidates.repeat_interleave(envs // count, dim=0)


class CMAES:
    """CMA-ES; see :class:`izoo.algos.learners.base.Algorithm`. It learns from batches of whole episodes.

    Attributes:
        reads: what it learns from: not the observations, which are nearly all that a batch holds.

    Args:
        config: hyper-parameters.
        features: length of an observation.
        space: of the actions; with a point mass, a policy whose weights are 0 leaves every vehicle alone.
        device: where the weights live.

    Raises:
        IzooError: an action is more than one number.
    """

    options: type[AlgoConfig] = CMAESConfig

    def __init__(
        self, config: CMAESConfig, features: int, space: ActionSpace, device: torch.device | str = "cpu"
    ) -> None:
        if space.size > 1:
            raise IzooError(
                f"algo=cmaes chooses one number, not {space.size}; choose action=speed with one part in "
                "env.action_parts, or action=direct or advise."
            )
        band = None if space.point_mass is None else config.initial_spread
        self._start(config, LinearPolicies(features, space, config.population, band).to(device))

    def _start(self, config: Any, policy: Any) -> None:
        """Begin to search the numbers of a module like :class:`LinearPolicies`."""
        self.config, self.policy = config, policy
        self.reads: base.Keys = (("next", TEAM_REWARD), ("next", "done"), *policy.reads)
        self.seed = int(torch.randint(2**31 - 1, ()))
        self.returns: list[np.ndarray] = []
        self._begin()

    def _begin(self) -> None:
        width = self.policy.mean.shape[-1]
        self.strategies = []
        for kind in range(self.policy.kinds):
            generator = np.random.default_rng([self.seed, kind] if kind else self.seed)
            options = {
                "popsize": self.config.population,
                "randn": lambda *shape, generator=generator: generator.standard_normal(shape),
                "seed": math.nan,  # the library's own would be numpy's global one
                "verbose": -9,
            }
            self.strategies.append(cma.CMAEvolutionStrategy(np.zeros(width), self.config.initial_spread, options))
        self._asked = [strategy.ask() for strategy in self.strategies]
        self._show()

    def _show(self) -> None:
        asked = np.stack([np.array(each) for each in self._asked], axis=1)
        means = np.stack([strategy.mean for strategy in self.strategies])
        self.policy.candidates.copy_(torch.from_numpy(asked).view_as(self.policy.candidates))
        self.policy.mean.copy_(torch.from_numpy(means).view_as(self.policy.mean))

    def _tell(self, returns: np.ndarray) -> None:
        """Tell the searches their candidates' returns, ``[kinds, population]``; NaN where no context is of a kind."""
        self.returns.append(returns)
        for kind, (strategy, own) in enumerate(zip(self.strategies, returns, strict=True)):
            if not np.isnan(own).any():
                strategy.tell(self._asked[kind], list(-own))
                self._asked[kind] = strategy.ask()
        self._show()

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Learn from a generation: whole episodes ``[N, T]`` with the team's rewards, environments in blocks.

        Raises:
            IzooError: the episodes are not whole.
        """
        reward, done = batch.get(("next", TEAM_REWARD)).squeeze(-1), batch.get(("next", "done")).squeeze(-1)
        if not (done[:, -1].all() and not done[:, :-1].any()):
            raise IzooError(
                "CMA-ES compares whole episodes: a batch must hold one of each environment, from its start."
            )
        population = self.config.population
        # Contexts in which driving makes little difference shall not be drowned by those where it makes much: what
        # counts is the difference to how the generation fares in the same context.
        returns = reward.double().sum(1).view(population, -1)
        relative = (returns - returns.mean(0)) / returns.mean(0).abs().clamp_min(1e-9)
        if self.config.most_difference is not None:
            relative = relative.clamp(-self.config.most_difference, self.config.most_difference)
        kinds = self.policy.kind_of(batch).view(population, -1)[0]
        fitness = np.full((self.policy.kinds, population), np.nan)
        for kind in range(self.policy.kinds):
            if (kinds == kind).any():
                fitness[kind] = relative[:, kinds == kind].mean(1).cpu().numpy()
        self._tell(fitness)
        told = fitness[~np.isnan(fitness).any(1)]
        return {
            "return_spread": float(told.std(1).mean()) if len(told) else 0.0,
            "return_best": float(told.max(1).mean()) if len(told) else 0.0,
            "search_spread": float(np.mean([strategy.sigma for strategy in self.strategies])),
            "weights_norm": float(self.policy.mean.norm()),
        }

    def state_dict(self) -> dict[str, Any]:
        """Return the seed and what each generation was told: the search is played again from these."""
        told = np.array(self.returns).reshape(-1, self.policy.kinds, self.config.population)
        return {"policy": self.policy.state_dict(), "seed": self.seed, "returns": torch.from_numpy(told)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        returns = state["returns"].numpy()
        self.seed, self.returns = int(state["seed"]), []
        self._begin()
        for told in returns:
            self._tell(told)
        self.policy.load_state_dict(state["policy"])
