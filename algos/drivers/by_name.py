"""Scripted drivers by name."""

from __future__ import annotations

from collections.abc import Callable

from tensordict.nn import TensorDictModuleBase

from izoo.algos.drivers.constant import CappedSpeed, ConstantAcceleration, ConstantSpeed
from izoo.algos.drivers.glide import Glide
from izoo.algos.drivers.random import RandomDriver
from izoo.algos.drivers.uncommanded import UncommandedDriver
from izoo.algos.learners.registry import cap_share
from izoo.envs.config import ACCELERATION, EnvConfig
from izoo.errors import unknown_choice

DRIVERS: dict[str, Callable[[EnvConfig], TensorDictModuleBase]] = {
    "human": UncommandedDriver,
    "uncommanded": UncommandedDriver,
    "constant": ConstantSpeed,
    "constant_2.0": lambda config: ConstantAcceleration(2.0),
    "random": RandomDriver,
    "glide": Glide,
}
"""Scripted drivers by name. ``human`` is human driving only where the adoption is 0, which evaluation sees to."""
COMMANDING = ("constant", "constant_2.0", "glide")
"""Those of them that command accelerations in every step."""


def make_driver(name: str, config: EnvConfig) -> TensorDictModuleBase:
    """Return the scripted driver ``name`` for environments with ``config``.

    Raises:
        IzooError: there is none, or it commands accelerations anew in every step and the environment takes none.
    """
    share = cap_share(name)
    if name in COMMANDING or (share is not None and config.action == ACCELERATION):
        config.require_accelerations(name, ", or choose uncommanded, random or, with env.action=speed, cap_SHARE")
    if share is not None:
        return CappedSpeed(config, share)
    if name not in DRIVERS:
        raise unknown_choice("scripted driver", name, [*DRIVERS, "cap_SHARE"])
    return DRIVERS[name](config)
