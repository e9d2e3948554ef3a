"""Hyper-parameters of CMA-ES, apart from it so that commands answer before PyTorch is loaded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from izoo.algos.learners.registry import AlgoConfig
from izoo.errors import check_range, check_types


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

    name: Literal["cmaes"] = "cmaes"
    population: int = 16
    initial_spread: float = 0.3
    most_difference: float | None = None
    frames_per_batch = 1  # no option: a batch is an episode of each environment, however long those are

    def __post_init__(self) -> None:
        check_types("algo", self)
        check_range("algo.population", self.population, 4, 4096)
        check_range("algo.initial_spread", self.initial_spread, 1e-6, 100.0)
        if self.most_difference is not None:
            check_range("algo.most_difference", self.most_difference, 1e-6, 100.0)

    @property
    def candidates(self) -> int:
        """How many policies are compared in each batch."""
        return self.population
