"""The weights that an entry of a benchmark is tested with: before training, or of which checkpoint."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase

from izoo.algos.learners.registry import make_algorithm
from izoo.conf.train_options import TrainConfig
from izoo.training import checkpoint


def untrained(config: TrainConfig) -> TensorDictModuleBase:
    """Return the policy with which a training run begins."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        policy: Any = make_algorithm(config.algo, config.action, config.env).policy
        return policy.eval()


def selected(run_dir: Path, select: str) -> Path:
    """Return the checkpoint of a run that is tested: its ``best``, where it was validated, or its ``last``."""
    best = checkpoint.best_of(run_dir) if select == "best" else None
    return best or checkpoint.find(run_dir)
