"""From command-line words to a validated dataclass: Hydra composes, and what it would refuse is explained here."""

from __future__ import annotations

import difflib
import functools
import itertools
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from typing import Any, TypeVar

from hydra import compose, initialize_config_module
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from izoo.algos.learners import registry
from izoo.conf.mapping import from_mapping, to_mapping
from izoo.conf.quoting import quoted
from izoo.contexts.cities.rebuilt import CITIES, city_name
from izoo.envs.config import EnvConfig, RewardConfig
from izoo.envs.mdp.reward import PRESETS
from izoo.errors import IzooError, unknown_choice

T = TypeVar("T")
CONFIG_MODULE = "izoo.conf"
DEFAULT_ALGORITHM = "ppo"
"""As in ``train.yaml``."""
MAX_CHECKED = 200
REWARD_CHOICE = "env.reward="


def choices() -> dict[str, tuple[str, ...]]:
    """Return the option groups and what each may be, for example ``{"algo": ("ppo", "ppo_paper"), ...}``."""
    folders = [entry for entry in resources.files(CONFIG_MODULE).iterdir() if entry.is_dir()]
    groups = {
        folder.name: tuple(sorted(file.name[:-5] for file in folder.iterdir() if file.name.endswith(".yaml")))
        for folder in folders
    }
    groups |= {"algo": registry.choices(), "env": ("default",)}
    return {name: groups[name] for name in sorted(groups) if groups[name]}


def register(config_name: str, cls: type) -> None:
    """Let Hydra find a command without a YAML file, whose options have no choices: its dataclass says everything."""
    if not (resources.files(CONFIG_MODULE) / f"{config_name}.yaml").is_file():
        ConfigStore.instance().store(name=config_name, node=to_mapping(cls()))


def _compose(config_name: str, words: Sequence[str]) -> DictConfig:
    """Let Hydra compose ``words``, after telling it what the dataclasses alone say.

    These are the environment's settings, and the hyper-parameters of the algorithm that is chosen.

    Raises:
        IzooError: it refuses, as where a command has no such group.
    """
    store = ConfigStore.instance().store
    store("default", to_mapping(EnvConfig()), group="env")
    named = [word.removeprefix("algo=").strip("'\"") for word in words if word.startswith("algo=")]
    for choice in {DEFAULT_ALGORITHM, *named}:
        store(choice, to_mapping(registry.preset(choice)), group="algo")
    try:
        with initialize_config_module(config_module=CONFIG_MODULE, version_base="1.3"):
            return compose(config_name=config_name, overrides=list(words))
    except (HydraException, OmegaConfBaseException) as error:
        raise IzooError(f"the options do not fit together: {str(error).splitlines()[0]}") from error


@functools.cache
def _skeleton(config_name: str, words: tuple[str, ...]) -> DictConfig:
    """Return every option that there is beside these choices; composing takes a tenth of a second."""
    return _compose(config_name, words)


def parse(words: Sequence[str], multirun: bool = False) -> list[Override]:
    """Parse ``option=value`` words; values that Hydra's grammar cannot read, such as odd paths, are taken literally.

    ``env.reward=NAME`` stands for the weights of that preset; other words change them, wherever they stand.

    Raises:
        IzooError: a word is not of that form, or lists several values outside a multirun.
    """
    parser = OverridesParser.create()
    overrides = []
    presets = [word for word in words if word.startswith(REWARD_CHOICE)]
    others = [word for word in words if word not in presets]
    for word in (*_reward_words(presets), *others):
        key, equals, value = word.partition("=")
        if not equals and not key.startswith("~"):
            raise IzooError(f"{word!r} is not of the form option=value; --help lists the options.")
        try:
            override = parser.parse_override(word)
        except HydraException:
            try:
                override = parser.parse_override(f"{key}={quoted(value)}")
            except HydraException:
                raise IzooError(f"cannot read {word!r}; options are written option=value.") from None
        if override.is_sweep_override() and not multirun:
            raise IzooError(
                f"{word!r} gives several values; add -m to run once for each, or quote it: {key}=\"'...'\"."
            )
        overrides.append(override)
    return overrides


def _reward_words(presets: Sequence[str]) -> list[str]:
    """Return the words of every weight of the reward preset that is chosen last."""
    if not presets:
        return []
    name = presets[-1].removeprefix(REWARD_CHOICE).strip("'\"")
    if name not in PRESETS:
        raise unknown_choice(REWARD_CHOICE[:-1], name, PRESETS)
    chosen: RewardConfig = getattr(RewardConfig, name)()
    return [f"env.reward.{option}={str(value).lower()}" for option, value in to_mapping(chosen).items()]


def check_names(config_name: str, overrides: Sequence[Override]) -> None:
    """Raise :class:`IzooError` for an unknown option or choice, naming the legal ones and the nearest."""
    groups = choices()
    chosen = [override for override in overrides if override.key_or_group in groups]
    for override in chosen:
        for value in _values(override):
            if value not in groups[override.key_or_group]:
                if override.key_or_group == "contexts" and value.lower().replace("-", "_") in CITIES:
                    raise IzooError(f"{value} is a city; write contexts=city contexts.city={city_name(value)}.")
                raise unknown_choice(override.key_or_group, value, groups[override.key_or_group])
    # A sweep over a group is checked against its first choice: the options of the others differ in the algorithm's own.
    words = tuple(f"{override.key_or_group}={_values(override)[0]}" for override in chosen)
    for override in overrides:
        if override not in chosen and not override.key_or_group.startswith("hydra"):
            _check_key(_skeleton(config_name, words), override.key_or_group)


def compose_config(config_name: str, cls: type[T], words: Sequence[str]) -> T:
    """Compose ``<config_name>.yaml`` with ``option=value`` words and return it as the dataclass ``cls``.

    Raises:
        IzooError: an option or choice is unknown, or a value is refused.
    """
    overrides = parse(words)
    register(config_name, cls)
    check_names(config_name, overrides)
    return to_dataclass(_compose(config_name, [_word(override) for override in overrides]), cls)


def check_combinations(config_name: str, cls: type[T], overrides: Sequence[Override]) -> list[T]:
    """Compose and return every combination of a multirun, so that a sweep fails before its first run.

    Sweeps too large to go through are checked as far as :data:`MAX_CHECKED` combinations.
    """
    words = [
        [f"{override.key_or_group}={value}" for value in override.sweep_string_iterator()]
        if override.is_sweep_override()
        else [_word(override)]
        for override in overrides
        if not override.key_or_group.startswith("hydra")
    ]
    combinations = itertools.islice(itertools.product(*words), MAX_CHECKED)
    return [compose_config(config_name, cls, combination) for combination in combinations]


def to_dataclass(composed: DictConfig, cls: type[T]) -> T:
    """Return a composed configuration as the dataclass ``cls``."""
    try:
        values = OmegaConf.to_container(composed, resolve=True)
    except OmegaConfBaseException as error:
        raise IzooError(f"an option cannot be resolved: {str(error).splitlines()[0]}") from error
    return from_mapping(cls, values)  # type: ignore[arg-type]


def clear() -> None:
    """Forget Hydra's global state, so that a command can be run again in the same process."""
    GlobalHydra.instance().clear()


def _word(override: Override) -> str:
    """Return the word that ``override`` was parsed from, quoted where that was needed."""
    return str(override.input_line)


def _values(override: Override) -> list[str]:
    if override.is_sweep_override():
        return list(override.sweep_string_iterator())
    return [str(override.value())]


def _check_key(skeleton: DictConfig, key: str) -> None:
    node: Any = skeleton
    path: list[str] = []
    for part in key.split("."):
        if not isinstance(node, Mapping) or part not in node:
            legal = [".".join([*path, str(name)]) for name in node] if isinstance(node, Mapping) else [".".join(path)]
            raise _unknown_option(key, legal, list(_paths(skeleton)))
        path.append(part)
        node = node[part]


def _unknown_option(key: str, legal: Sequence[str], everything: Sequence[str]) -> IzooError:
    """Name the legal options beside ``key``, and the nearest of all: by its full path, or by its last part."""
    by_leaf = {path.rsplit(".", 1)[-1]: path for path in reversed(everything)}
    leaf = difflib.get_close_matches(key.rsplit(".", 1)[-1], by_leaf, n=1, cutoff=0.75)
    close = difflib.get_close_matches(key, [*legal, *everything], n=1, cutoff=0.8) or [by_leaf[name] for name in leaf]
    owners = _choices_with(key)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    if owners:
        hint = f" It is an option of {' and '.join(owners)}, which is not chosen."
    return IzooError(f"unknown option {key!r}; choose one of: {', '.join(legal)}.{hint}")


def _choices_with(key: str) -> list[str]:
    """Return the choices, such as ``contexts=dataset``, that have the option ``key``."""
    group, _, name = key.partition(".")
    found = []
    for choice in choices().get(group, ()):
        if group == "algo":
            options: Any = vars(registry.preset(choice))
        elif group == "env":
            options = to_mapping(EnvConfig())
        else:
            options = OmegaConf.create((resources.files(CONFIG_MODULE) / group / f"{choice}.yaml").read_text())
        if name in options:
            found.append(f"{group}={choice}")
    return found


def _paths(node: Any, prefix: str = "") -> Iterator[str]:
    for name in node:
        path = f"{prefix}{name}"
        yield path
        if isinstance(node[name], Mapping):
            yield from _paths(node[name], f"{path}.")
