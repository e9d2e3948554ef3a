"""Offline data: the steps of a policy, collected as memory-mapped TensorDicts."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.collectors import Collector

from izoo.algos.drivers.random import RandomDriver
from izoo.conf.train_options import CollectConfig
from izoo.console import Progress, graceful_interrupt, workers_ignore_interrupts
from izoo.contexts.source import RandomSchedule
from izoo.envs import make, simulator_of
from izoo.errors import IzooError, UnfinishedError
from izoo.files import claimed_empty
from izoo.gpu import check_gpu
from izoo.results.playing import Policy
from izoo.training import run_folder
from izoo.training.process_collector import ENDLESS
from izoo.training.stored_steps import StepsWriter, pack

FRAMES_PER_BATCH = 1000


def collect(config: CollectConfig) -> Path:
    """Step environments with a policy and store every step.

    The folder holds a file per leaf, and ``manifest.json``, which is replaced whole after each batch: what it counts is
    complete, whenever the command is stopped.

    Args:
        config: the options.

    Returns:
        The folder.

    Raises:
        IzooError: ``out`` is missing, not empty or in use, or the policy or the contexts cannot be used.
        UnfinishedError: nothing more can be written.
        KeyboardInterrupt: after Ctrl-C, once what was collected is a whole data set.
    """
    if config.out is None:
        raise IzooError("out is missing; name a new folder for the data: out=DIR.")
    out = Path(config.out)
    policy = make_policy(config)
    source = config.contexts.build()
    with claimed_empty(out, "out"):
        collector = _make_collector(config, policy, RandomSchedule(source, config.seed))
        writer = StepsWriter(config, out)
        try:
            with graceful_interrupt() as interrupt, Progress(config.frames) as bar:
                for batch in collector:
                    steps = batch.transpose(0, 1).reshape(-1)
                    if writer.frames == 0:
                        _say_size(config, out, steps)
                    writer.write(steps)
                    bar.update(writer.frames)
                    if interrupt.requested or writer.frames >= config.frames:
                        break
        except OSError as error:
            raise UnfinishedError(
                f"could not write to {out}: {error}; {writer.frames:,} steps are complete. Make room if the disk is "
                "full, and collect the rest into another folder."
            ) from error
        finally:
            collector.shutdown()
    print(f"Data: {out}", flush=True)
    if interrupt.requested:
        raise KeyboardInterrupt
    return out


def _say_size(config: CollectConfig, out: Path, steps: TensorDictBase) -> None:
    """Say how large the data will be, by the first steps ``[n]``."""
    step_bytes = pack(steps).bytes() / len(steps)
    size, free = (f"{number / 1e9:.3g} GB" for number in (step_bytes * config.frames, shutil.disk_usage(out).free))
    print(f"{config.frames:,} steps of some {step_bytes / 1e3:.1f} kB: {size} in {out} ({free} are free).", flush=True)


def _make_collector(config: CollectConfig, policy: Policy, schedule: RandomSchedule) -> Collector:
    """Return the source of batches, which has begun its first episodes."""
    options: dict[str, Any] = {}
    if simulator_of(config.simulator).batched:
        options = {"threads": config.twin.threads, "surrogate": config.twin.surrogate}
        if config.twin.surrogate == "cuda":
            check_gpu("twin.surrogate", "torch")
    with workers_ignore_interrupts():
        env = make(config.simulator, config.environments, schedule, config.env, seed=config.seed, shard=0, **options)
        torch.manual_seed(config.seed)
        try:
            return Collector(
                env,
                policy,
                frames_per_batch=-(-FRAMES_PER_BATCH // env.batch_size.numel()) * env.batch_size.numel(),
                **ENDLESS,
            )
        except BaseException:
            if not env.is_closed:
                env.close()
            raise


def make_policy(config: CollectConfig) -> Policy:
    """Return the policy that ``config.policy`` names.

    Raises:
        IzooError: there is none, or it was trained on other observations or decisions.
    """
    if config.policy == "random":
        return RandomDriver(config.env)
    found = run_folder.any_policy(config.policy, config.env)
    if found.trained is not None and found.trained.decision_s != config.env.decision_s:
        theirs, ours = (f"{env.decision_s:g}" for env in (found.trained, config.env))
        raise IzooError(
            f"the policy of {config.policy} decides every {theirs} s, and env every {ours} s; set env.hold_s={theirs}."
        )
    return found.policy.eval() if isinstance(found.policy, nn.Module) else found.policy
