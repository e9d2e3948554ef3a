"""Options of ``python -m izoo.benchmarks.tradeoffs``."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from typing import Any, cast

from izoo.benchmarks.generalization_options import FLOOR_INFIX, SWEPT, Entry, GeneralizationConfig, parse_entry
from izoo.envs.config import RewardConfig
from izoo.errors import IzooError


@dataclass(frozen=True)
class TradeoffsConfig(GeneralizationConfig):
    """Options of the trade-offs: those of the generalization benchmark, and what is swept over.

    Every combination of the reward's weights is a point; a list that is empty keeps the reward's default.

    Attributes:
        learner: preset of the algorithm that is trained, with ``_residual`` appended for ``action=residual``.
        eta: share of the fleet's mean in the reward.
        alpha: weight of stopping.
        beta: weight of emission.
        comfort: weight of the comfort term.
        realism: weight of the kinematic-realism term.
        safety: weight of the fleet's time to collision.
        floors_mps: lowest speeds that glide advises, a point each.
        algos: what is shown beside them, as in the generalization benchmark.
        seeds: training seeds per point.
    """

    algos: tuple[str, ...] = ("uncommanded",)
    seeds: int | None = 1
    learner: str = "ppo"
    eta: tuple[float, ...] = ()
    alpha: tuple[float, ...] = ()
    beta: tuple[float, ...] = (-1.0, -3.0, -10.0)
    comfort: tuple[float, ...] = ()
    realism: tuple[float, ...] = ()
    safety: tuple[float, ...] = ()
    floors_mps: tuple[float, ...] = (2.0, 5.0, 8.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if parse_entry(self.learner).kind != "trained":
            raise IzooError(f"learner is {self.learner!r}, which is not trained; choose a preset such as ppo.")
        for weights in self.weights().values():
            dataclasses.replace(RewardConfig(), **cast(Any, weights))  # raises for a weight out of range

    def weights(self) -> dict[str, dict[str, float]]:
        """Return the swept weights of every trained point, by the entry's name."""
        swept = {name: getattr(self, name) for name in SWEPT if getattr(self, name)}
        points = [dict(zip(swept, values, strict=True)) for values in itertools.product(*swept.values())]
        return {
            "_".join([self.learner, *(f"{name}{value:g}" for name, value in point.items())]): point for point in points
        }

    def entries(self) -> list[Entry]:
        """Return all points: those without training first."""
        base = parse_entry(self.learner)
        points: list[Any] = [parse_entry(f"{FLOOR_INFIX}{floor:g}") for floor in self.floors_mps]
        for name, point in self.weights().items():
            words = tuple(f"env.reward.{weight}={value}" for weight, value in point.items())
            points.append(dataclasses.replace(base, name=name, options=words))
        others = [entry for entry in super().entries() if entry.name not in {point.name for point in points}]
        return sorted([*others, *points], key=lambda entry: entry.kind == "trained")
