"""The tasks that have names. Nothing on this page may change but sentences: published results are of these tasks."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

from izoo.algos.actions.action_modes import DirectAction, SpeedAction
from izoo.algos.learners import registry
from izoo.conf.built_in import CityContexts, Split
from izoo.conf.context_choices import ContextsConfig, PcgContexts
from izoo.conf.folders import DatasetContexts
from izoo.contexts.cities.rebuilt import CITIES
from izoo.contexts.cities.weather import WEATHER_PUBLISHED
from izoo.envs import COMPILED
from izoo.envs.config import BEFORE, VEHICLE, EnvConfig
from izoo.envs.mdp.reward import RewardConfig
from izoo.errors import IzooError, unknown_choice
from izoo.imports import imported
from izoo.tasks.task import Task

SPLITS: tuple[Split, ...] = ("train", "validation", "test")
PAPER = "_paper"
"""Ends the names of tasks in the paper's form."""
ON_TWIN = {
    **registry.ON_TWIN,
    "validation": {"contexts": 32, "seeds": 1, "simulator": COMPILED},
    "evaluation": {"contexts": 16, "seeds": 1},
}
ONCE = EnvConfig(decide=VEHICLE, action="speed", action_parts=BEFORE, reward=RewardConfig.fuel())
"""A CV decides once, when it enters: a desired speed for its way to the stop line."""
_SPEED = SpeedAction(initial=0.75)
"""Untrained policies choose speeds around three quarters of the limit."""
_RULE = "the rule zoo:measured_search, searched for on measured intersections, saves; no learner is shown to save more"


def _city(city: str, split: Split) -> CityContexts:
    return CityContexts(city=city, split=split, weather="published" if city in WEATHER_PUBLISHED else "county")


def _task(name: str, about: str, learns: str, roles: Sequence[ContextsConfig], env: EnvConfig = ONCE) -> Task:
    train, validation, test = roles
    return Task(name, about, learns, train, validation, test, env, _SPEED, ON_TWIN)


def _busy_lane() -> Task:
    busy = PcgContexts(
        lane_count=1,
        phase_count=1,
        inflow_vph_per_lane="400..600",
        green_s="20..26",
        red_s="24..32",
        lane_length_m="250..500",
    )
    return _task(
        "busy_lane",
        "one-lane approaches near capacity, where smooth driving helps most: can it learn at all?",
        "PPO that decides once per vehicle (algo=ppo_vehicle: what make train does), imitation "
        "(algo=ppo_imitation) and search (algo=cmaes_teams)",
        (busy, busy, busy),
        env=dataclasses.replace(ONCE, num_agents=32, num_vehicles=128),
    )


def _systematicity() -> Task:
    wide = PcgContexts(preset="systematicity_train")
    return _task(
        "systematicity",
        "wide procedural ranges, tested inside a box that training excludes",
        _RULE,
        (wide, wide, PcgContexts(preset="systematicity_grid")),
    )


def _in_city(city: str) -> Task:
    words = city.replace("_", " ").title()
    return _task(
        city,
        f"approaches of {words}, rebuilt from published statistics; intersections split 80/10/10",
        _RULE if city == "salt_lake_city" else "not tried yet",
        [_city(city, split) for split in SPLITS],
    )


def _paper_form(task: Task) -> Task:
    """Return a task as the paper has it: an acceleration in every step, its reward, and no intersections held out."""
    roles = {role: getattr(task, role) for role in ("train", "validation", "test")}
    whole = {
        role: dataclasses.replace(contexts, split="all") if hasattr(contexts, "split") else contexts
        for role, contexts in roles.items()
    }
    return dataclasses.replace(
        task,
        name=task.name + PAPER,
        about=f"{task.name} as in the paper: an acceleration in every step, its reward"
        + (", trained and tested on all intersections" if whole != roles else ""),
        learns="the paper reports PPO and DDPG; not reproduced",
        env=dataclasses.replace(task.env.with_accelerations(), reward=RewardConfig.paper()),
        action=DirectAction(low_mps2=-20.0, high_mps2=10.0),
        **whole,
    )


@functools.cache
def tasks() -> dict[str, Task]:
    """Return every task that has a name, in the order of the help."""
    slc, atlanta = "salt_lake_city", "atlanta"
    measured = [DatasetContexts(split=split) for split in SPLITS]
    own = [
        _busy_lane(),
        _systematicity(),
        *(_in_city(city) for city in CITIES),
        _task(
            f"{slc}_to_{atlanta}",
            "trained in Salt Lake City and tested, zero-shot, in Atlanta",
            _RULE,
            [_city(slc, "train"), _city(slc, "validation"), _city(atlanta, "test")],
        ),
        _task(
            "measured",
            "measured intersections of the published dataset, split 80/10/10; needs contexts.path=DATASET",
            "nothing is shown to; the search for a rule (algo=glide_search_teams) comes nearest",
            measured,
        ),
        _task(
            f"measured_to_{atlanta}",
            "trained on measured intersections and tested, zero-shot, in Atlanta; needs contexts.path=DATASET",
            _RULE,
            [*measured[:2], _city(atlanta, "test")],
        ),
    ]
    return {task.name: task for task in (*own, *map(_paper_form, own))}


def names() -> tuple[str, ...]:
    """Return the names of all tasks."""
    return tuple(tasks())


def make(name: str, **conditions: Any) -> Task:
    """Return a task.

    Args:
        name: one of :func:`names`, or ``module:NAME`` of one's own.
        conditions: that differ: ``adoption``, ``cv_vehicle`` and ``path`` of :meth:`Task.changed`.

    Raises:
        IzooError: there is no such task.
    """
    if ":" in name:
        task = imported("task", name)
        if not isinstance(task, Task):
            raise IzooError(f"task={name} is a {type(task).__name__}; give an izoo.tasks.Task.")
    elif name in tasks():
        task = tasks()[name]
    else:
        raise unknown_choice("task", name, names())
    return task.changed(**conditions)
