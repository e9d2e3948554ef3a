"""Hyper-parameters of the search over glide's settings, apart from it so that commands answer before PyTorch loads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from izoo.algos.registry import AlgoConfig
from izoo.errors import check_range, check_types


@dataclass(frozen=True)
class GlideSearchConfig(AlgoConfig):
    """Hyper-parameters of CMA-ES over the settings of glide, one set for roads of one lane and one for several.

    Attributes:
        name: the algorithm.
        population: rules of a generation, each of which plays the same contexts and seeds (arXiv 1604.00772: 4 + 3 ln
            n, which is 13 for 19 numbers; ours 16). It divides ``num_envs``.
        initial_spread: standard deviation of the first generation's numbers (ours 0.5: settings differ by a sixth).
    """

    name: Literal["glide_search"] = "glide_search"
    population: int = 16
    initial_spread: float = 0.5
    frames_per_batch = 1  # no option: a batch is an episode of each environment, however long those are
    needs_env: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_types("algo", self)
        check_range("algo.population", self.population, 4, 4096)
        check_range("algo.initial_spread", self.initial_spread, 1e-6, 100.0)

    @property
    def candidates(self) -> int:
        """How many policies are compared in each batch."""
        return self.population
