"""The groups of options that have choices (``algo=ddpg``, ``contexts=pcg``), and what each choice stands for."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, get_args

from izoo.algos.actions.action_modes import ActionConfig
from izoo.algos.learners import registry
from izoo.conf.context_choices import ContextsConfig, OwnContexts, PcgContexts
from izoo.conf.train_options import LoggerConfig
from izoo.envs.config import RewardConfig
from izoo.envs.mdp.reward import PRESETS
from izoo.errors import unknown_choice
from izoo.options import field_types

Choices = Mapping[str, Callable[[], Any]]
TAKES_OWN: dict[str, Callable[[str], Any]] = {"algo": registry.preset, "contexts": OwnContexts}
"""Groups whose choice may also be ``module:name``."""


def _by_name(*classes: Any) -> Choices:
    """Return the names that the ``name`` of dataclasses may be, each with what makes one."""
    return {
        name: functools.partial(kind, name=name) for kind in classes for name in get_args(field_types(kind)["name"])
    }


@functools.cache
def groups() -> dict[str, Choices]:
    """Return the choices of each group, by the path of its options."""
    return {
        "algo": {name: functools.partial(registry.preset, name) for name in registry.choices()},
        "action": _by_name(*get_args(ActionConfig)),
        "contexts": {
            **_by_name(*get_args(ContextsConfig)),
            "pcg_easy": functools.partial(PcgContexts, preset="easy"),
            "systematicity_test": functools.partial(PcgContexts, preset="systematicity_grid"),
        },
        "logger": _by_name(LoggerConfig),
        "env.reward": {name: getattr(RewardConfig, name) for name in PRESETS},
    }


def choose(group: str, name: str) -> Any:
    """Return the options that ``group=name`` stands for; raises :class:`IzooError` where there is no such choice."""
    known = groups()[group]
    if ":" in name and group in TAKES_OWN:
        return TAKES_OWN[group](name)
    if name not in known:
        raise unknown_choice(group, name, [*known, *(["module:name"] if group in TAKES_OWN else [])])
    return known[name]()
