"""The algorithms and drivers that can be chosen by name: one line for each.

Nothing here loads PyTorch before an algorithm is built, so that commands can read names and options at once.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from izoo.errors import IzooError, unknown_choice

if TYPE_CHECKING:
    import torch

    from izoo.algos.actions.action_modes import ActionConfig
    from izoo.algos.learners.base import Algorithm
    from izoo.envs.config import EnvConfig

DRIVER_NAMES = ("human", "uncommanded", "constant", "constant_2.0", "random", "glide")
"""Scripted drivers (:data:`izoo.algos.drivers.by_name.DRIVERS`); ``cap_SHARE`` is one for any share:
:func:`cap_share`."""
CAP = "cap_"


def cap_share(name: str) -> float | None:
    """Return the share of the limit that a driver ``cap_SHARE`` keeps to, such as 0.6 of ``cap_0.6``; else ``None``.

    Raises:
        IzooError: the share is not in (0, 1].
    """
    if not name.startswith(CAP):
        return None
    try:
        share = float(name.removeprefix(CAP))
    except ValueError:
        share = 0.0
    if not 0.0 < share <= 1.0:
        raise IzooError(f"{name!r} is not a speed cap; give a share of the limit above 0 and up to 1, such as cap_0.6.")
    return share


class AlgoConfig:
    """Hyper-parameters of an algorithm: a frozen dataclass whose field ``name`` is its name in :data:`ALGORITHMS`.

    Attributes:
        name: the algorithm.
        frames_per_batch: environment steps, over all workers, between two updates.
    """

    name: str
    frames_per_batch: int
    needs_env: ClassVar[bool] = False
    """Whether the algorithm is also told the settings of the environment, ``env=``."""

    @property
    def candidates(self) -> int:
        """How many policies are compared in each batch, which then holds whole episodes; 1: there is one policy."""
        return 1

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> type[AlgoConfig]:
        """Return the class of the hyper-parameters whose ``name`` stands in ``values``.

        Raises:
            IzooError: there is no such algorithm.
        """
        name = values.get("name")
        if not isinstance(name, str) or name not in ALGORITHMS:
            raise unknown_choice("algo.name", name, ALGORITHMS)
        return _imported(ALGORITHMS[name].config)


@dataclass(frozen=True)
class Home:
    """Where an algorithm lives, as ``module:Class``.

    Attributes:
        algorithm: called with its hyper-parameters, the length of an observation, the bounds of its action, and
            ``device=``, it returns an :class:`izoo.algos.learners.base.Algorithm`.
        config: its :class:`AlgoConfig`; the defaults are the choice ``algo=NAME``. In a module of its own commands need
            not load PyTorch to read it.
        presets: class methods of the config; each is the choice ``algo=NAME_PRESET``.
    """

    algorithm: str
    config: str
    presets: tuple[str, ...] = ()


ALGORITHMS = {
    "ppo": Home("izoo.algos.learners.ppo:PPO", "izoo.algos.learners.ppo_config:PPOConfig", ("paper",)),
    "ddpg": Home("izoo.algos.learners.ddpg:DDPG", "izoo.algos.learners.ddpg_config:DDPGConfig", ("paper",)),
    "td3": Home("izoo.algos.learners.td3:TD3", "izoo.algos.learners.ddpg_config:TD3Config"),
    "mappo": Home("izoo.algos.learners.mappo:MAPPO", "izoo.algos.learners.ppo_config:MAPPOConfig", ("paper",)),
    "cmaes": Home("izoo.algos.learners.cmaes:CMAES", "izoo.algos.learners.cmaes_config:CMAESConfig"),
    "glide_search": Home(
        "izoo.algos.learners.glide_search:GlideSearch", "izoo.algos.learners.glide_search_config:GlideSearchConfig"
    ),
    "gcrl": Home("izoo.algos.learners.graph_ppo:GCRL", "izoo.algos.learners.ppo_config:GCRLConfig", ("paper",)),
}


def choices() -> tuple[str, ...]:
    """Return what ``algo=`` may be: every algorithm, and every preset of one."""
    return tuple(
        sorted(choice for name, home in ALGORITHMS.items() for choice in (name, *(f"{name}_{p}" for p in home.presets)))
    )


def preset(choice: str) -> AlgoConfig:
    """Return the hyper-parameters that a choice of :func:`choices` stands for."""
    for name, home in ALGORITHMS.items():
        for made in home.presets:
            if choice == f"{name}_{made}":
                return getattr(_imported(home.config), made)()
    if choice not in ALGORITHMS:
        raise unknown_choice("algo", choice, choices())
    return _imported(ALGORITHMS[choice].config)()


def make_algorithm(
    algo: AlgoConfig, action: ActionConfig, env: EnvConfig, device: torch.device | str = "cpu"
) -> Algorithm:
    """Build the algorithm of the options ``algo`` and ``action`` for what ``env`` lets it observe, on ``device``."""
    import torch

    from izoo.envs.mdp.frame import observation_names

    told = {"env": env} if algo.needs_env else {}
    build = functools.partial(_imported(ALGORITHMS[algo.name].algorithm), device=device, **told)
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)  # that of observations
    try:
        return action.algorithm(build, algo, len(observation_names(env)), env)
    finally:
        torch.set_default_dtype(before)


def _imported(place: str) -> Any:
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)
