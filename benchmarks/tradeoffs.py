"""What less CO2 costs in time: ``python -m izoo.benchmarks.tradeoffs eta=[0,1] beta=[-1,-10]``.

Trains one algorithm for every combination of reward weights, evaluates all of them, and glide with several lowest
speeds, on the same test contexts, and leaves ``tradeoffs.csv`` and ``tradeoffs.png`` (emission against travel time,
with the Pareto front) in a results folder that is otherwise that of the generalization benchmark.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from izoo.commands.option_command import GOES_ON, OptionCommand

if TYPE_CHECKING:
    from izoo.benchmarks.tradeoffs_options import TradeoffsConfig

PLOT_FILE = "tradeoffs.png"


def run(config: TradeoffsConfig, given: frozenset[str] = frozenset()) -> Path:
    """Run a sweep, or the rest of one, and return its folder."""
    from rich.console import Console

    from izoo.benchmarks import pareto
    from izoo.benchmarks.campaign import Campaign
    from izoo.benchmarks.outcome import title_of
    from izoo.files import write_text
    from izoo.reporting.material import TRADEOFFS_FILE

    config = config.resolved()
    folder = Path(config.out) if config.out else Path.cwd() / "results" / f"tradeoffs-{config.scale}"
    print(f"Trade-offs of {config.learner}, scale {config.scale}: reading contexts.", flush=True)
    campaign = Campaign(config, folder)
    print(f"{len(campaign.entries)} points; test on {campaign.plan.test_text}.", flush=True)
    with campaign.open():
        results = campaign.run(submit=False)
        points = pareto.points(folder, results, config.weights())
        write_text(folder / TRADEOFFS_FILE, points.to_csv(index=False))
        pareto.plot(points, folder / PLOT_FILE, title_of(results))
    Console().print(pareto.table(points, f"Trade-offs, {title_of(results)}"))
    print(f"Results: {folder / TRADEOFFS_FILE} and {PLOT_FILE}", flush=True)
    return folder


COMMAND = OptionCommand(
    name="benchmarks.tradeoffs",
    summary="Sweep over the weights of the reward, and plot emission against travel time.",
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
