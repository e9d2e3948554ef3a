"""What the commands share: the first line, options, help, sweeps, and errors that are one sentence.

This module imports nothing heavy, so that a command says something at once; PyTorch and SUMO follow.
"""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
import sys
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from izoo import __version__
from izoo.console import EXIT_BAD_INPUT, exit_code, stop_requested, unheard
from izoo.errors import IzooError, unknown_choice

HELP_WIDTH = 110
Work = Callable[[Any, frozenset[str]], object]
FOLDERS = ("run_dir", "out")
"""Options that name where a command's results go."""
FLAGS = ("--help", "-h", "--multirun", "-m", "--cfg", "--version")


@dataclass(frozen=True)
class Command:
    """A command ``python -m izoo.<name>``.

    Attributes:
        name: also the name of its YAML file in ``izoo/conf``.
        summary: one sentence for ``--help``.
        examples: command lines for ``--help``, without ``python -m``.
        config: imports and returns the dataclass of the options.
        work: imports and returns what does the work, ``work()(config, given)``, where ``given`` are the names of the
            options that were written on the command line. It is called once the options are known to be good.
    """

    name: str
    summary: str
    examples: tuple[str, ...]
    config: Callable[[], type]
    work: Callable[[], Work]


def run(command: Command, argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code: 0, 2 for input that cannot be used, 130 when it was stopped."""
    words = list(sys.argv[1:] if argv is None else argv)
    # Idle OpenMP threads would otherwise spin on the cores that the simulators need.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL would announce every replay buffer
    return exit_code(command.name, lambda: _run(command, words))


def _run(command: Command, words: Sequence[str]) -> int:
    print(f"izoo {__version__} {command.name}", flush=True)
    flags = [word for word in words if word.startswith("-")]
    options = [word for word in words if not word.startswith("-")]
    for flag in flags:
        if flag not in FLAGS:
            raise unknown_choice("flag", flag, FLAGS)
    if "--version" in flags:
        return 0
    config_class = command.config()
    from izoo.conf import compose

    if "--help" in flags or "-h" in flags:
        print(help_text(command, config_class, compose.choices()))
        return 0
    if "-m" in flags or "--multirun" in flags:
        return _multirun(command, config_class, options)
    config: Any = compose.compose_config(command.name, config_class, options)
    if "--cfg" in flags:
        print(to_yaml(config), end="")
        return 0
    with unheard():
        command.work()(config, _given(options))
    return 0


def _multirun(command: Command, config_class: type, options: Sequence[str]) -> int:
    """Run once for each combination, through Hydra's launcher; the first bad input stops the sweep."""
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import DictConfig

    from izoo.conf import compose

    overrides = compose.parse(options, multirun=True)
    compose.check_names(command.name, overrides)
    combinations: list[Any] = compose.check_combinations(command.name, config_class, overrides)
    given = _given(options)
    for name in FOLDERS:
        folders = [folder for config in combinations if (folder := getattr(config, name, None)) is not None]
        if len(set(folders)) < len(folders):
            raise IzooError(
                f"{len(folders)} runs would share the folder {folders[0]}; make {name} differ by an option that does, "
                f"as in {name}='{folders[0]}/${{seed}}'."
            )
    stop_requested.clear()

    def job(composed: DictConfig) -> None:
        try:
            config: Any = compose.to_dataclass(composed, config_class)
            if getattr(config, "run_dir", "") is None:
                output = HydraConfig.get().runtime.output_dir
                config = dataclasses.replace(config, run_dir=output)
            compose.clear()  # the work may compose options, too
            with unheard():
                command.work()(config, given)
        except IzooError as error:
            print(f"izoo {command.name}: {error}", file=sys.stderr, flush=True)
            raise SystemExit(EXIT_BAD_INPUT) from None
        if stop_requested.is_set():
            raise KeyboardInterrupt

    compose.clear()
    arguments = sys.argv
    sys.argv = [command.name, *(override.input_line or "" for override in overrides), "--multirun"]
    try:
        hydra.main(version_base="1.3", config_path=f"pkg://{compose.CONFIG_MODULE}", config_name=command.name)(job)()
    except SystemExit as stop:
        return int(stop.code or 0)
    finally:
        sys.argv = arguments
    return 0


def _given(options: Sequence[str]) -> frozenset[str]:
    return frozenset(word.partition("=")[0].lstrip("+~") for word in options)


def to_yaml(config: Any) -> str:
    """Return a configuration dataclass as YAML."""
    from omegaconf import OmegaConf

    from izoo.conf.mapping import to_mapping

    return OmegaConf.to_yaml(OmegaConf.create(to_mapping(config)))


def help_text(command: Command, config_class: type, groups: dict[str, tuple[str, ...]]) -> str:
    """Return the help page: usage, examples, choices, and every option with its default and meaning."""
    lines = [command.summary, "", f"Usage: python -m izoo.{command.name} [option=value ...]", "", "Examples:"]
    lines += [f"  python -m {example}" for example in command.examples]
    lines += ["", "Flags:", "  -h, --help      this page", "  -m, --multirun  run once for each combination of"]
    lines[-1] += " comma-separated values, as in seed=0,1,2"
    lines += ["  --cfg           print the resolved options and stop"]
    default = config_class()
    fields = [field.name for field in dataclasses.fields(config_class)]
    chosen = [name for name in groups if name in fields]
    if chosen:
        lines += ["", "Choices:"]
        lines += [f"  {name}={' | '.join(groups[name])}" for name in chosen]
    lines += ["", "Options, with their defaults (another choice has options of its own: --cfg shows them):"]
    nested = [name for name in fields if dataclasses.is_dataclass(getattr(default, name))]
    lines += _describe({name: getattr(default, name) for name in fields if name not in nested}, "", config_class)
    for name in nested:
        lines += ["", f"{name}:"]
        lines += _describe_group(getattr(default, name), name)
    return "\n".join(lines)


def _describe_group(group: Any, path: str) -> list[str]:
    values = {field.name: getattr(group, field.name) for field in dataclasses.fields(group) if field.name != "name"}
    plain = {key: value for key, value in values.items() if not dataclasses.is_dataclass(value)}
    lines = _describe(plain, f"{path}.", type(group))
    for key, value in values.items():
        if key not in plain:
            lines += _describe_group(value, f"{path}.{key}")
    return lines


def _describe(values: dict[str, Any], prefix: str, owner: type) -> list[str]:
    meanings = attribute_docs(owner)
    lines = []
    for name, value in values.items():
        lines.append(f"  {prefix}{name}={_as_word(value)}")
        lines += textwrap.wrap(meanings.get(name, ""), HELP_WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return lines


def _as_word(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(_as_word(item) for item in value) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def attribute_docs(owner: type) -> dict[str, str]:
    """Return the texts of the ``Attributes:`` sections of a class's docstring and its bases', by name."""
    docs: dict[str, str] = {}
    for part in reversed(owner.__mro__[:-1]):
        docs.update(_section(inspect.cleandoc(part.__doc__ or "")))
    return docs


def _section(text: str) -> dict[str, str]:
    _, _, section = text.partition("Attributes:\n")
    docs: dict[str, str] = {}
    names: list[str] = []
    for line in section.splitlines():
        head = re.match(r"    (\w+(?:, \w+)*): (.*)", line)
        if head:
            names = [name.strip() for name in head.group(1).split(",")]
            docs.update({name: head.group(2) for name in names})
        elif names and line.startswith("        "):
            docs.update({name: f"{docs[name]} {line.strip()}" for name in names})
        elif line.strip():
            break
    return {name: doc.replace("``", "") for name, doc in docs.items()}
