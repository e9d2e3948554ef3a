"""Environments: cooperative eco-driving on SUMO, or on its compiled twin, as TorchRL environments.

- :class:`EcoDrivingEnv`: one intersection, in this process.
- :class:`SumoParallelEnv`: several on SUMO, each in a worker process.
- :class:`TwinEnv`: many on the twin, in this process.
- :class:`EnvConfig`, :class:`RewardConfig`: their settings.
- :func:`make`: environments on any simulator; :data:`SIMULATORS`: those there are, and what each can do.
- :data:`MODEL_VERSION`: results of different ones are not comparable.
- :mod:`izoo.envs.views.gymnasium`: ``gymnasium.make("izoo.envs:izoo/EcoDriving-v0")`` and
  ``"izoo.envs:izoo/EcoDrivingEgo-v0"``.
- :mod:`izoo.envs.views.pettingzoo`: the parallel API of PettingZoo.

Names are loaded when first used, so that worker processes do not pay for torch.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import register

from izoo.envs.model_version import MODEL_VERSION
from izoo.errors import check_choice
from izoo.imports import imported
from izoo.metrics import REFERENCE

if TYPE_CHECKING:
    from izoo.envs.backend import Backend
    from izoo.envs.config import EnvConfig, RewardConfig
    from izoo.envs.env import Contexts, EcoDrivingBase, EcoDrivingEnv
    from izoo.envs.side_by_side import SideBySideEnv, SumoParallelEnv
    from izoo.envs.twin_env import TwinEnv

_HOME = {
    "EcoDrivingEnv": "env",
    "EnvConfig": "config",
    "RewardConfig": "config",
    "SumoParallelEnv": "side_by_side",
    "TwinEnv": "twin_env",
}
__all__ = [
    "COMPILED",
    "MODEL_VERSION",
    "REFERENCE",
    "SIMULATORS",
    "EcoDrivingEnv",
    "EnvConfig",
    "RewardConfig",
    "Simulator",
    "SumoParallelEnv",
    "TwinEnv",
    "make",
    "simulator_of",
]


@dataclass(frozen=True)
class Simulator:
    """Where a simulator lives, and what it can do.

    Attributes:
        label: what sentences call it.
        backend: ``module:Class``: given the settings, and how many, it makes the backend of environments in this
            process (:class:`~izoo.envs.backend.Backend`).
        several: ``module:Class``: environments side by side, made as by :func:`make`; empty:
            :class:`~izoo.envs.side_by_side.SideBySideEnv` on ``backend``.
        check: ``module:function``: raises :class:`~izoo.errors.IzooError` for settings that it cannot play.
        batched: environments side by side are stepped in this process, and not each in a process of its own.
        saves: they can be saved, copied, and played on for a while by themselves (``state_dict``, ``branch``,
            ``advance``).
        window: it can show itself in a window.
    """

    label: str
    backend: str
    several: str = ""
    check: str = ""
    batched: bool = False
    saves: bool = False
    window: bool = False

    def make_backend(self, config: EnvConfig, num_envs: int = 1, **options: Any) -> Backend:
        """Return the backend of environments in this process."""
        return imported("simulator", self.backend)(config, num_envs, **options)

    def environments(self) -> type[SideBySideEnv]:
        """Return the class of environments side by side."""
        if self.several:
            return imported("simulator", self.several)
        return type("SideBySide", (imported("simulator", "izoo.envs.side_by_side:SideBySideEnv"),), {"simulator": self})

    def check_settings(self, config: EnvConfig) -> None:
        """Raise :class:`~izoo.errors.IzooError` for settings that it cannot play."""
        if self.check:
            imported("simulator", self.check)(config)


SIMULATORS = {
    "sumo": Simulator(
        "SUMO", "izoo.envs.sumo.simulator:SumoSimulator", "izoo.envs.side_by_side:SumoParallelEnv", window=True
    ),
    "twin": Simulator(
        "the twin",
        "izoo.envs.twin.backend:TwinBackend",
        "izoo.envs.twin_env:TwinEnv",
        "izoo.envs.twin.backend:check_settings",
        batched=True,
        saves=True,
    ),
}
"""Every simulator by its name; a further one is a line here, and a folder beside ``envs/sumo``."""
COMPILED = "twin"
"""The reference's compiled copy, on which presets and tasks train."""


def simulator_of(name: str, option: str = "simulator") -> Simulator:
    """Return a simulator; raises :class:`~izoo.errors.IzooError` where there is none of that name."""
    check_choice(option, name, SIMULATORS)
    return SIMULATORS[name]


def make(
    simulator: str = REFERENCE,
    n: int | None = None,
    contexts: Contexts | None = None,
    config: EnvConfig | None = None,
    **options: Any,
) -> EcoDrivingBase:
    """Return environments as one TorchRL environment.

    Args:
        simulator: a name of :data:`SIMULATORS`.
        n: how many, side by side: batch size ``[n]``; ``None``: one, in this process, of batch size ``[]``.
        contexts, config: as for :class:`EcoDrivingEnv`.
        options: of :class:`EcoDrivingEnv`, or of the simulator's environments side by side.
    """
    chosen = simulator_of(simulator)
    if n is None:
        return imported("simulator", "izoo.envs.env:EcoDrivingEnv")(
            contexts, config=config, simulator=simulator, **options
        )
    return chosen.environments()(n, contexts, config=config, **options)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


for _name, _view in (("EcoDriving", "Joint"), ("EcoDrivingEgo", "Ego")):
    register(
        id=f"izoo/{_name}-v0",
        entry_point=f"izoo.envs.views.gymnasium:EcoDriving{_view}",
        vector_entry_point=f"izoo.envs.views.gymnasium:{_view.lower()}_vector",
    )
