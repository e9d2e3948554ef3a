"""What less CO2 costs in time: ``python -m izoo.benchmarks.tradeoffs eta=[0,1] beta=[-1,-10]``.

Trains one algorithm for every combination of reward weights, tests all of them, and glide with several lowest speeds,
in the same episodes, and leaves ``tradeoffs.png`` (CO2 saved against added delay) in a results folder that is otherwise
that of the generalization benchmark.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from izoo.commands.option_command import GOES_ON, OptionCommand

if TYPE_CHECKING:
    from izoo.benchmarks.tradeoffs_options import TradeoffsConfig

PLOT_FILE = "tradeoffs.png"
COSTS = ("co2_g", "delay_s")
"""Figures that are traded; lower is better."""


def run(config: TradeoffsConfig, given: frozenset[str] = frozenset()) -> Path:
    """Run a sweep, or the rest of one, and return its folder."""
    from izoo.benchmarks.campaign import Campaign
    from izoo.benchmarks.comparing import show
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
    config="izoo.benchmarks.tradeoffs_options:TradeoffsConfig",
    work="izoo.benchmarks.tradeoffs:run",
    check="izoo.commands.given_paths:check_benchmark",
    stopped=GOES_ON,
)


main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
