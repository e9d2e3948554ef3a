"""A trained policy and the options without which it means nothing, in one file."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from izoo.algos.actions.action_modes import ActionConfig
from izoo.algos.learners import registry
from izoo.algos.learners.registry import AlgoConfig, make_algorithm
from izoo.conf.train_options import TrainConfig
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.errors import IzooError
from izoo.files import check_parts, expanded, reading, replacing
from izoo.options import from_mapping, to_mapping, written
from izoo.zoo import catalog

if TYPE_CHECKING:
    from tensordict.nn import TensorDictModuleBase

FORMAT = "izoo-policy-1"
KEPT = ("algo", "action", "env")
"""The options of a run that decide what its policy does."""


@dataclass(frozen=True)
class TrainedPolicy:
    """A policy that was trained, with what it has to be played with.

    Attributes:
        name: its name in tables.
        policy: reads ``("agents", "observation")`` ``[*B, A, F]`` and ``("agents", "mask")`` ``[*B, A]`` and writes
            ``("agents", "action")`` ``[*B, A, 1]`` in m/s^2 and, where its action mode knows it,
            ``("agents", "defer")``.
        env: the environment that it was trained in: what it observes, and how long a decision lasts.
        algo, action: how its networks were made.
    """

    name: str
    policy: TensorDictModuleBase
    env: EnvConfig
    algo: AlgoConfig
    action: ActionConfig


def check_fits(policy: str, trained: EnvConfig, env: EnvConfig) -> None:
    """Raise :class:`IzooError` unless ``env`` lets a policy observe, and takes at its times, what it was trained on.

    Args:
        policy: what it is called in the message.
        trained: the environment that it was trained in.
        env: the one in which it is to act.
    """
    if observation_names(env) != observation_names(trained):
        raise IzooError(
            f"{policy} was trained on other observations than the env options describe; leave env.observed and "
            "env.neighbours out."
        )
    for name in ("decide", "action", "action_parts"):
        theirs, ours = (written(getattr(config, name)) for config in (trained, env))
        if theirs != ours:
            raise IzooError(
                f"{policy} was trained with env.{name}={theirs}, and here it is {ours}; set env.{name}={theirs}."
            )


def full_episodes(env: EnvConfig) -> EnvConfig:
    """Return an environment whose episodes training may have shortened with episodes as evaluations play them."""
    whole = EnvConfig()
    return dataclasses.replace(env, horizon_s=whole.horizon_s, warmup_s=whole.warmup_s)


def load(name: str) -> TrainedPolicy:
    """Return a policy, ready to act.

    Args:
        name: of one that ships with izoo, or the path of a file ``NAME.pt`` that ``python -m izoo.zoo export`` wrote.

    Raises:
        IzooError: no policy of that name ships, and the message lists those that do; or the file cannot be used.
    """
    return read(expanded(name) if name.endswith(catalog.WEIGHTS) else catalog.weights(name))


def read(path: Path) -> TrainedPolicy:
    """Read a policy that :func:`write` wrote. Nothing that a foreign file may hold is run.

    Raises:
        IzooError: the file is missing, damaged, or of another version.
    """
    import torch

    with reading(path):
        check_parts(path)
        state: Any = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(state, dict) or state.get("format") != FORMAT:
            raise ValueError(f"it is not a policy of format {FORMAT}")
        _check_algorithm(str(state["options"]["algo"]["name"]), path)
        try:
            config = from_mapping(TrainConfig, {name: state["options"][name] for name in KEPT})
        except IzooError as error:
            raise IzooError(f"{path}: {error}") from error
        policy = make_algorithm(config.algo, config.action, config.env).policy
        policy.load_state_dict(state["policy"])
    return TrainedPolicy(path.stem, policy.eval(), config.env, config.algo, config.action)


def write(path: Path, config: TrainConfig, policy: TensorDictModuleBase) -> None:
    """Write the policy of a run, and of its options those in :data:`KEPT`; all or nothing.

    Args:
        path: the file; its stem becomes the policy's name.
        config: options of the run.
        policy: the algorithm's.

    Raises:
        IzooError: the algorithm is not one of izoo's.
    """
    import torch

    _check_algorithm(config.algo.name, path)
    env = dataclasses.replace(full_episodes(config.env), emit=EnvConfig().emit)
    options = to_mapping(dataclasses.replace(config, env=env))
    state = {name: tensor.detach().cpu() for name, tensor in policy.state_dict().items()}
    with replacing(path) as partial:
        torch.save({"format": FORMAT, "options": {name: options[name] for name in KEPT}, "policy": state}, partial)


def _check_algorithm(name: str, path: Path) -> None:
    """Raise :class:`IzooError` for an algorithm of somebody's own code, which a file could make izoo import and run."""
    if name not in registry.ALGORITHMS:
        raise IzooError(
            f"{path} cannot hold a policy of algo={name}; files of policies are of {', '.join(registry.ALGORITHMS)} "
            "alone, and a run of another algorithm is evaluated by run=FOLDER."
        )
