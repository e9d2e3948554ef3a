"""Which algorithm generalises? ``python -m izoo.benchmarks.generalization protocol=NAME scale=smoke|small|paper``.

Trains every algorithm with every seed, and tests it on contexts that it has not seen, beside human driving and
uncommanded CVs in the same episodes. An interrupted benchmark goes on where it stopped. It leaves one folder::

    RESULTS/
      settings.yaml            every option of the benchmark, resolved; what a second start is checked against
      rows.csv, manifest.json  what was played (izoo.results.store)
      summary.json             figures of every task that was tested (izoo.metrics.summary)
      learning_curves.png      of all training runs; not where nothing was trained
      train/ENTRY/seedK/       run folders of izoo.train
      leaderboard/ENTRY.json   a leaderboard file per entry (izoo.report.leaderboard)
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from izoo.cli.option_command import GOES_ON, OptionCommand

if TYPE_CHECKING:
    from izoo.benchmarks.campaign.generalization_options import GeneralizationConfig


def run(config: GeneralizationConfig, given: frozenset[str] = frozenset()) -> Path:
    """Run a benchmark, or the rest of one, and return its folder."""
    from izoo.benchmarks.campaign.comparing import show
    from izoo.benchmarks.campaign.jobs import Campaign
    from izoo.report.leaderboard import write_entries

    config = config.resolved()
    folder = Path(config.out) if config.out else Path.cwd() / "results" / f"{config.protocol}-{config.scale}"
    print(f"Protocol {config.protocol}, scale {config.scale}: reading contexts.", flush=True)
    campaign = Campaign(config, folder)
    print(f"{campaign.plan.task}: train on {campaign.plan.train_text}; test on {campaign.plan.test_text}.", flush=True)
    found = campaign.run()
    write_entries(folder)
    print(f"\nResults: {folder}", flush=True)
    show(found, config.verbose)
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
    config="izoo.benchmarks.campaign.generalization_options:GeneralizationConfig",
    work="izoo.benchmarks.generalization:run",
    check="izoo.cli.path_checks:check_benchmark",
    stopped=GOES_ON,
)


main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
