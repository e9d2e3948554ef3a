"""Which algorithm generalises? ``python -m izoo.benchmarks.generalization protocol=NAME scale=smoke|small|paper``.

Trains every algorithm with every seed, evaluates it paired with human driving on contexts that it has not seen, and
leaves one folder (:mod:`izoo.reporting.results`). An interrupted benchmark goes on where it stopped.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from izoo.commands.option_command import GOES_ON, OptionCommand

if TYPE_CHECKING:
    from izoo.benchmarks.generalization_options import GeneralizationConfig


def run(config: GeneralizationConfig, given: frozenset[str] = frozenset()) -> Path:
    """Run a benchmark, or the rest of one, and return its folder."""
    from rich.console import Console

    from izoo.benchmarks.campaign import Campaign
    from izoo.benchmarks.outcome import draw_curves, outcome_tables

    config = config.resolved()
    folder = Path(config.out) if config.out else Path.cwd() / "results" / f"{config.protocol}-{config.scale}"
    print(f"Protocol {config.protocol}, scale {config.scale}: reading contexts.", flush=True)
    campaign = Campaign(config, folder)
    print(f"{campaign.plan.title}: train on {campaign.plan.train_text}; test on {campaign.plan.test_text}.", flush=True)
    with campaign.open():
        results = campaign.run()
        draw_curves(folder, results)
    Console().print(outcome_tables(results))
    print(f"Results: {folder}", flush=True)
    return folder


COMMAND = OptionCommand(
    name="benchmarks.generalization",
    summary="Train and test algorithms as the paper's protocols say, and collect the results in one folder.",
    examples=(
        "izoo.benchmarks.generalization",
        "izoo.benchmarks.generalization protocol=productivity scale=small train=salt_lake_city test=atlanta",
        "izoo.benchmarks.generalization protocol=systematicity algos=[ppo,ppo_residual,glide] episodes=200",
        "izoo.benchmarks.generalization train=DATASET scale=small out=results/measured",
    ),
    config="izoo.benchmarks.generalization_options:GeneralizationConfig",
    work="izoo.benchmarks.generalization:run",
    check="izoo.commands.given_paths:check_benchmark",
    stopped=GOES_ON,
)


main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
