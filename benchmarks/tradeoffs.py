"""What less CO2 costs in time: ``python -m izoo.benchmarks.tradeoffs eta=[0,1] beta=[-1,-10]``.

Trains one algorithm for every combination of reward weights, tests all of them, and glide with several lowest speeds,
in the same episodes, and leaves ``tradeoffs.png`` (CO2 saved against added delay) in a results folder that is otherwise
that of the generalization benchmark.
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from izoo.benchmarks.campaign.generalization_options import FLOOR_INFIX, SWEPT, Entry, GeneralizationConfig, parse_entry
from izoo.cli.option_command import GOES_ON, OptionCommand
from izoo.envs.config import RewardConfig
from izoo.errors import IzooError

PLOT_FILE = "tradeoffs.png"
COSTS = ("co2_g", "delay_s")
"""Figures that are traded; lower is better."""


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


def run(config: TradeoffsConfig, given: frozenset[str] = frozenset()) -> Path:
    """Run a sweep, or the rest of one, and return its folder."""
    from izoo.benchmarks.campaign.comparing import show
    from izoo.benchmarks.campaign.jobs import Campaign
    from izoo.report.plots import tradeoff
    from izoo.training.plots import draw, save

    config = config.resolved()
    folder = Path(config.out) if config.out else Path.cwd() / "results" / f"tradeoffs-{config.scale}"
    print(f"Trade-offs of {config.learner}, scale {config.scale}: reading contexts.", flush=True)
    campaign = Campaign(config, folder)
    print(f"{len(campaign.entries)} points; test on {campaign.plan.test_text}.", flush=True)
    found = campaign.run()
    chart = tradeoff(found[0])
    if chart is not None:
        save(draw([chart]), folder / PLOT_FILE)
    print(f"\nResults: {folder}, {PLOT_FILE}", flush=True)
    verdict = f"{found[0]['verdict'][:-1]}; {front_in_words(found[0])}."
    show([{**found[0], "verdict": verdict}, *found[1:]], config.verbose)
    return folder


def on_front(costs: Mapping[str, tuple[float, ...]]) -> list[str]:
    """Return the points that no other point dominates: is as good in all costs, and better in one.

    Args:
        costs: by point; lower is better.
    """

    def dominated(mine: tuple[float, ...]) -> bool:
        return any(other != mine and all(o <= m for o, m in zip(other, mine, strict=True)) for other in costs.values())

    return [name for name, mine in costs.items() if not dominated(mine)]


def front_in_words(summary: Mapping[str, Any]) -> str:
    """Say which entries are on the Pareto front of CO2 and delay per vehicle."""
    levels = {name: entry["levels"].get(summary["block"], {}) for name, entry in summary["entries"].items()}
    costs = {name: tuple(of[key] for key in COSTS) for name, of in levels.items() if None not in map(of.get, COSTS)}
    return f"on the Pareto front of CO2 and delay: {', '.join(on_front(costs)) or 'none'}"


COMMAND = OptionCommand(
    name="benchmarks.tradeoffs",
    summary="Sweep over the weights of the reward, and plot CO2 saved against added delay.",
    examples=(
        "izoo.benchmarks.tradeoffs",
        "izoo.benchmarks.tradeoffs eta=[0,0.5,1] beta=[-1,-3,-10] scale=small seeds=4",
        "izoo.benchmarks.tradeoffs learner=ddpg comfort=[0,1] protocol=systematicity floors_mps=[1,3,5,8]",
    ),
    config="izoo.benchmarks.tradeoffs:TradeoffsConfig",
    work="izoo.benchmarks.tradeoffs:run",
    check="izoo.cli.path_checks:check_benchmark",
    stopped=GOES_ON,
)


main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
