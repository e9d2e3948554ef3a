"""The algorithms and drivers that can be chosen by name, and hyper-parameters in general.

Nothing here loads PyTorch: an algorithm's module is imported once its options, or the algorithm, are asked for.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from izoo.envs import COMPILED
from izoo.envs.config import SPEED
from izoo.errors import IzooError, unknown_choice
from izoo.imports import imported
from izoo.options import CheckedOptions, Ranges

if TYPE_CHECKING:
    import torch

    from izoo.algos.actions.action_modes import ActionConfig
    from izoo.algos.learners.base import Algorithm
    from izoo.envs.config import EnvConfig

DRIVER_NAMES = ("human", "uncommanded", "constant", "constant_2.0", "random", "glide")
"""Scripted drivers (:data:`izoo.algos.drivers.by_name.DRIVERS`); ``cap_SHARE`` is one for any share:
:func:`cap_share`."""
CAP = "cap_"

ON_TWIN: Mapping[str, Any] = {"simulator": COMPILED, "twin": {"surrogate": "compiled"}}
"""Options of a run that plays on the twin."""


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


@dataclass(frozen=True)
class AlgoConfig(CheckedOptions):
    """Hyper-parameters of an algorithm; further ones are fields of a frozen dataclass that is derived from this.

    Attributes:
        name: the algorithm: a key of :data:`ALGORITHMS`, or ``module:Class``.
        frames_per_batch: environment steps, over all workers, between two updates.
    """

    name: str = ""
    frames_per_batch: int = 1950
    group = "algo"
    ranges: ClassVar[Ranges] = (("frames_per_batch", 1, 10**9),)
    needs_env: ClassVar[bool] = False
    """Whether the algorithm is also told the settings of the environment, ``env=``."""
    starts_with: ClassVar[str] = ""
    """Kind of network of the policies, of other runs, that it can begin with; empty: with none."""
    estimates_advantages: ClassVar[bool] = False
    """Whether it estimates advantages, which say how much a context still teaches."""
    runs: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Options of the run that go with a preset, by its name: how it acts, what it sees, how long it learns."""

    @classmethod
    def class_of(cls, name: str) -> type[AlgoConfig]:
        """Return the class of the hyper-parameters of an algorithm; see :func:`algorithm_class`."""
        return getattr(algorithm_class(name), "options", AlgoConfig)

    @property
    def candidates(self) -> int:
        """How many policies are compared in each batch, which then holds whole episodes; 1: there is one policy."""
        return 1

    @property
    def emits(self) -> tuple[str, ...]:
        """Groups that the environment has to emit for this algorithm."""
        team = ("team_reward",) if self.candidates > 1 else ()
        return (*team, *(("number",) if self.variate == "vehicle" else ()))

    @property
    def variate(self) -> str:
        """What the uncommanded episode's rewards are subtracted from: ``vehicle``, ``team`` or ``none``.

        With either, every training episode is played a second time, uncommanded.
        """
        return "none"

    def by_step(self, run: Any) -> tuple[str, ...]:
        """Return the options with which it learns from decisions in every step alone."""
        return (f"algo={self.name}",) if self.candidates > 1 else ()

    def check_run(self, run: Any) -> None:
        """Raise :class:`IzooError` where other options of a run do not go with these.

        Args:
            run: an :class:`izoo.conf.train_options.TrainConfig`.
        """
        if run.levels.draw == "prioritised" and not self.estimates_advantages:
            raise IzooError(
                f"levels.draw=prioritised scores contexts by estimated advantages, and algo={self.name} has none; "
                "choose algo=ppo, mappo or gcrl, or levels.draw=uniform."
            )
        if run.start is not None and not self.starts_with:
            raise IzooError(
                f"start={run.start} begins with the policy of another run, which algo={self.name} cannot: what it "
                "keeps beside its policy would not fit. Choose algo=ppo, mappo or gcrl, or leave start out."
            )


class Home(typing.NamedTuple):
    """Where an algorithm lives.

    Attributes:
        place: ``module:Class``. The class is called with its hyper-parameters, the length of an observation, an
            :class:`izoo.algos.actions.action_modes.ActionSpace`, and ``device=``, and is an
            :class:`izoo.algos.learners.base.Algorithm`. Its attribute ``options`` is the class of its hyper-parameters;
            without one it has those of :class:`AlgoConfig`.
        presets: class methods of ``options``; each is the choice ``algo=NAME_PRESET``.
    """

    place: str
    presets: tuple[str, ...] = ()


_LIKE_PPO = ("paper", "vehicle", "imitation")
ALGORITHMS = {
    "ppo": Home("izoo.algos.learners.ppo:PPO", _LIKE_PPO),
    "ddpg": Home("izoo.algos.learners.ddpg:DDPG", ("paper",)),
    "td3": Home("izoo.algos.learners.td3:TD3"),
    "mappo": Home("izoo.algos.learners.mappo:MAPPO", _LIKE_PPO),
    "gcrl": Home("izoo.algos.learners.graph_ppo:GCRL", _LIKE_PPO),
    "cmaes": Home("izoo.algos.learners.cmaes:CMAES", ("teams",)),
    "glide_search": Home("izoo.algos.learners.glide_search:GlideSearch", ("teams",)),
}


def choices() -> tuple[str, ...]:
    """Return what ``algo=`` may be by name: every algorithm, and every preset of one."""
    return tuple(
        sorted(choice for name, home in ALGORITHMS.items() for choice in (name, *(f"{name}_{p}" for p in home.presets)))
    )


def algorithm_class(name: str) -> Any:
    """Return the class of an algorithm: by its name, or ``module:Class``.

    Raises:
        IzooError: there is none.
    """
    if name not in ALGORITHMS and ":" not in name:
        raise unknown_choice("algo", name, choices())
    return imported("algo", ALGORITHMS[name].place if name in ALGORITHMS else name)


def preset(choice: str) -> AlgoConfig:
    """Return the hyper-parameters that a choice of ``algo=`` stands for: see :func:`choices`, or ``module:Class``."""
    name, made = _split(choice)
    options = AlgoConfig.class_of(name)
    config = getattr(options, made)() if made else options()
    return config if name in ALGORITHMS else dataclasses.replace(config, name=name)


def run_options(choice: str) -> Mapping[str, Any]:
    """Return the options of a run that go with a choice of ``algo=``, by group and name."""
    name, made = _split(choice)
    return AlgoConfig.class_of(name).runs.get(made, {}) if made else {}


def _split(choice: str) -> tuple[str, str]:
    """Return the algorithm's name, and the preset's or an empty text."""
    presets = {f"{name}_{made}": (name, made) for name, home in ALGORITHMS.items() for made in home.presets}
    return presets.get(choice, (choice, ""))


def make_algorithm(
    algo: AlgoConfig, action: ActionConfig, env: EnvConfig, device: torch.device | str = "cpu"
) -> Algorithm:
    """Build the algorithm of the options ``algo`` for what ``env`` lets it observe, on ``device``.

    Its actions are transformed as ``action`` says, and it learns from executed ones if it asks for that.
    """
    import torch

    from izoo.algos.actions.action_modes import ArriveAction, SpeedAction
    from izoo.algos.actions.action_wrappers import ExecutedAcceleration, ExecutedActions, TransformedAlgorithm
    from izoo.algos.drivers.by_name import make_driver
    from izoo.envs.mdp.frame import observation_names

    if isinstance(action, (SpeedAction, ArriveAction)):
        values: dict[str, Any] = {"initial_accel_mps2": action.initial, "initial_spread": action.spread}
        algo = dataclasses.replace(algo, **{name: value for name, value in values.items() if hasattr(algo, name)})
    space, transform = action.space(env), action.transform(env)
    told = {"env": env} if algo.needs_env else {}
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)  # that of observations
    try:
        learned = algorithm_class(algo.name)(algo, len(observation_names(env)), space, device=device, **told)
        replays = getattr(algo, "stores", "commanded") == "applied" and env.action != SPEED
        executed = ExecutedAcceleration(env) if replays else None
        if transform is None:
            return learned if executed is None else ExecutedActions(learned, executed)
        expert = getattr(algo, "warm_start", "none")
        driver = None if expert == "none" else make_driver(expert, env)
        return TransformedAlgorithm(learned, transform, space.high, expert=driver, executed=executed)
    finally:
        torch.set_default_dtype(before)
