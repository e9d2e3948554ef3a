"""The policy that an entry of a benchmark is tested with: trained weights, weights before training, or a driver."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import torch
from tensordict.nn import TensorDictModuleBase

from izoo.algos.registry import make_algorithm
from izoo.algos.scripted import Glide, GlideConfig
from izoo.benchmarks.generalization_options import Entry, GeneralizationConfig
from izoo.benchmarks.plan import Plan, train_config
from izoo.conf.train_options import TrainConfig
from izoo.envs.config import EnvConfig
from izoo.training import checkpoint, runs


def contestant(
    config: GeneralizationConfig, plan: Plan, env: EnvConfig, entry: Entry, seed: int, run_dir: Path
) -> TensorDictModuleBase | str:
    """Return what :func:`izoo.evaluation.evaluate_policy` takes for an entry.

    Args:
        config: resolved options of the benchmark.
        env: of the evaluation.
        seed: of training; an untrained policy begins as the run of this seed does.
        run_dir: of its training run, where it has one.
    """
    if entry.kind == "trained":
        return runs.load_policy(_selected(config, run_dir))
    if entry.algo is not None:
        return untrained(train_config(config, plan, entry, seed, run_dir))
    if entry.floor_mps is not None:
        return Glide(env, GlideConfig(floor_mps=entry.floor_mps))
    return cast(str, entry.policy)


def untrained(config: TrainConfig) -> TensorDictModuleBase:
    """Return the policy with which a training run begins."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        policy: Any = make_algorithm(config.algo, config.action, config.env).policy
        return policy.eval()


def _selected(config: GeneralizationConfig, run_dir: Path) -> Path:
    """Return the checkpoint that is tested."""
    best = checkpoint.best_of(run_dir) if config.select == "best" else None
    if config.select == "best" and best is None:
        print("The run was too short to be validated: its last weights are tested.", flush=True)
    return best or checkpoint.find(run_dir)
