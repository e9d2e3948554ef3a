"""Hyper-parameters of the search over glide's settings, apart from it so that commands answer before PyTorch loads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from izoo.algos.learners.cmaes_config import CMAESConfig


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

    name: Literal["glide_search"] = "glide_search"  # type: ignore[assignment]
    initial_spread: float = 0.5
    most_difference: float | None = 0.1
    needs_env: ClassVar[bool] = True
