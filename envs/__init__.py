"""Environments: cooperative eco-driving on SUMO, or on its compiled twin, as TorchRL environments.

- :class:`EcoDrivingEnv`: one intersection, in this process.
- :class:`SumoParallelEnv`: several on SUMO, each in a worker process.
- :class:`TwinEnv`: many on the twin, in this process.
- :class:`EnvConfig`, :class:`RewardConfig`: their settings.
- :data:`MODEL_VERSION`: results of different ones are not comparable.
- :mod:`izoo.envs.views.gymnasium`: ``gymnasium.make("izoo.envs:izoo/EcoDriving-v0")`` and
  ``"izoo.envs:izoo/EcoDrivingEgo-v0"``.
- :mod:`izoo.envs.views.pettingzoo`: the parallel API of PettingZoo.

Names are loaded when first used, so that worker processes do not pay for torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import register

from izoo.envs.model_version import MODEL_VERSION

if TYPE_CHECKING:
    from izoo.envs.config import EnvConfig, RewardConfig
    from izoo.envs.env import EcoDrivingEnv, SumoParallelEnv
    from izoo.envs.twin_env import TwinEnv

_HOME = {
    "EcoDrivingEnv": "env",
    "EnvConfig": "config",
    "RewardConfig": "config",
    "SumoParallelEnv": "env",
    "TwinEnv": "twin_env",
}
__all__ = ["MODEL_VERSION", "EcoDrivingEnv", "EnvConfig", "RewardConfig", "SumoParallelEnv", "TwinEnv"]


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
