"""What a trained policy sets of an evaluation, where other options do not; PyTorch is loaded where there is one."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from izoo import tasks, zoo
from izoo.conf.mapping import to_mapping
from izoo.conf.train_options import TrainConfig
from izoo.envs.config import BY_STEP
from izoo.files import expanded
from izoo.zoo import catalog


def defaults(said: Mapping[str, str]) -> dict[str, Any]:
    """Return what a trained policy sets where other options do not.

    That is its environment, of which a task leaves it what it observes and decides; and, of a run, what its task is
    tested on, or else its own contexts.

    Args:
        said: the written options by name.
    """
    run, policy, has_task = said.get("run", "null"), said.get("policy", "null"), said.get("task", "null") != "null"
    found: dict[str, Any] = {}
    if run != "null":
        from izoo.training import checkpoint, run_folder

        path = checkpoint.find(expanded(run), said.get("checkpoint", "last"))
        trained = run_folder.read_config(checkpoint.run_of(path))
        task, env = _tested(trained), zoo.full_episodes(trained.env)
        if not has_task and "contexts" not in said:
            found = {"contexts": trained.contexts}
        if found and task is not None:
            env = dataclasses.replace(env, horizon_s=task.env.horizon_s, warmup_s=task.env.warmup_s)
            found = {"contexts": task.test, "num_contexts": task.test_contexts, "seeds": task.test_episodes}
            found["task"] = trained.task
    elif shipped := catalog.named(policy):
        env = zoo.load(shipped).env
    else:  # drivers that are written by hand command accelerations
        return {"env": {**BY_STEP, "hold_s": None}}
    from izoo.results.store import own_settings

    own = own_settings(env) if has_task else set(to_mapping(env)) - {"emit", "drain_s"}
    return {**found, "env": {name: value for name, value in to_mapping(env).items() if name in own}}


def _tested(trained: TrainConfig) -> tasks.Task | None:
    """Return the task of a run, unless it was trained on other contexts than those of the task."""
    if trained.task is None:
        return None
    task = tasks.make(trained.task, path=getattr(trained.contexts, "path", None))
    return task if to_mapping(task.train) == to_mapping(trained.contexts) else None
