"""Defaults of options that come from a resumed run or a trained policy; PyTorch is loaded where it is needed."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from izoo import tasks, zoo
from izoo.algos.learners.registry import DRIVER_NAMES
from izoo.conf.train_options import TrainConfig
from izoo.envs.config import BY_STEP, EnvConfig
from izoo.errors import IzooError
from izoo.files import expanded
from izoo.options import to_mapping
from izoo.zoo import catalog


def of_run(named: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of the run that ``resume`` names; raises :class:`IzooError` where there is none, or another
    folder is named.
    """
    if named.get("resume") is None:
        return {}
    if "run_dir" in named:
        raise IzooError("a resumed run stays in its folder; leave run_dir out.")
    from izoo.training import run_folder

    return vars(run_folder.resumed(expanded(str(named["resume"])).absolute()))


def of_policies(named: Mapping[str, Any]) -> dict[str, Any]:
    """Return the environment of the last trained policy that is named; ``env.emit`` stays the command's."""
    policies = named.get("policies", [named.get("policy")])
    found = list(filter(None, map(trained_env, policies if isinstance(policies, list) else ())))
    return {"env": {name: value for name, value in to_mapping(found[-1]).items() if name != "emit"}} if found else {}


def trained_env(policy: Any) -> EnvConfig | None:
    """Return the environment of a policy that ships, was exported, or is that of a run, with full episodes."""
    name = str(policy or "")
    if not name or name in DRIVER_NAMES:
        return None
    if shipped := catalog.named(name):
        return zoo.load(shipped).env
    if not expanded(name).exists():
        return None
    from izoo.training import checkpoint, run_folder

    return zoo.full_episodes(run_folder.read_config(checkpoint.run_of(checkpoint.find(expanded(name)))).env)


def of_evaluation(named: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a trained policy sets of an evaluation.

    That is its environment, of which a task leaves it what it observes and decides; and, of a run, what its task is
    tested on, or else its own contexts.
    """
    has_task, found = named.get("task") is not None, {}  # type: bool, dict[str, Any]
    if named.get("run") is not None:
        from izoo.training import checkpoint, run_folder

        path = checkpoint.find(expanded(str(named["run"])), str(named.get("checkpoint", "last")))
        trained = run_folder.read_config(checkpoint.run_of(path))
        task, env = _tested(trained), zoo.full_episodes(trained.env)
        if not has_task and "contexts" not in named:
            found = {"contexts": trained.contexts}
        if found and task is not None:
            env = dataclasses.replace(env, horizon_s=task.env.horizon_s, warmup_s=task.env.warmup_s)
            found = {"contexts": task.test, "num_contexts": task.test_contexts, "seeds": task.test_episodes}
            found["task"] = trained.task
    elif (own_env := trained_env(named.get("policy"))) is None:  # drivers written by hand command accelerations
        return {"env": {**BY_STEP, "hold_s": None}}
    else:
        env = own_env
    from izoo.results.store import own_settings

    own = own_settings(env) if has_task else set(to_mapping(env)) - {"emit", "drain_s"}
    return {**found, "env": {name: value for name, value in to_mapping(env).items() if name in own}}


def _tested(trained: TrainConfig) -> tasks.Task | None:
    """Return the task of a run, unless it was trained on other contexts than those of the task."""
    if trained.task is None:
        return None
    task = tasks.make(trained.task, path=getattr(trained.contexts, "path", None))
    return task if to_mapping(task.train) == to_mapping(trained.contexts) else None
