"""``python -m izoo.train``: train a policy on eco-driving contexts and compare it with human driving."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from izoo.cli.option_command import OptionCommand

if TYPE_CHECKING:
    from izoo.conf.train_options import TrainConfig


def run(config: TrainConfig) -> Path:
    """Train, print the comparison that ends the run, and return the run's folder."""
    from izoo.report.tables import print_summary
    from izoo.training import loop

    return loop.train(config, print_summary)


COMMAND = OptionCommand(
    name="train",
    summary="Train a policy on eco-driving contexts, then compare it with human driving.",
    examples=(
        "izoo.train task=busy_lane algo=ppo_vehicle seed=1",
        "izoo.train contexts=pcg_easy total_frames=100000 seed=1",
        "izoo.train task=measured contexts.path=DIR algo=glide_search_teams",
        "izoo.train algo=my_algorithms:Mine contexts=my_contexts:hills algo.lr=1e-4 num_workers=8",
        "izoo.train -m task=busy_lane algo=ppo_vehicle,mappo_vehicle seed=0,1,2,3",
        "izoo.train resume=runs/RUN total_frames=500000",
    ),
    config="izoo.conf.train_options:TrainConfig",
    work="izoo.train:run",
    defaults="izoo.cli.defaults:of_run",
)
main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
