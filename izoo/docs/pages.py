"""What the documentation site generates: every option, every command's help, the source of the examples.

MkDocs calls the functions ``on_*``. A page asks for generated text with one of the comments of :data:`MARKERS`; readers
of the bare Markdown files see nothing of it.
"""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import html
import importlib
import io
import os
import pkgutil
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from izoo.cli.help_page import as_word, attribute_docs
from izoo.cli.option_command import OptionCommand
from izoo.conf import compose
from izoo.envs.config import EnvConfig, RewardConfig
from izoo.envs.mdp.observation import observation_columns
from izoo.envs.mdp.reward import TERMS
from izoo.errors import IzooError, unknown_choice

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parent.parent
MARKER = re.compile(r"^<!-- (options|commands|source|observation|reward)(?:: (\S+))? -->$", re.MULTILINE)
HELP_COLUMNS = "100"


def option_docs(config: type) -> dict[str, str]:
    """Return what the docstrings of a dataclass and of those it extends say of each option."""
    docs: dict[str, str] = {}
    for owner in reversed(config.__mro__):
        docs |= attribute_docs(owner)
    return docs


def modules() -> dict[str, Any]:
    """Return the modules that ``python -m`` runs, by the name that it takes."""
    names = ["izoo.train", "izoo.evaluate", "izoo.collect", "izoo.report.__main__"]
    names += ["izoo.contexts.__main__", "izoo.drivers.__main__"]
    for package in ("izoo", "izoo.benchmarks"):
        path = importlib.import_module(package).__path__
        names += [f"{package}.{module.name}" for module in pkgutil.iter_modules(path) if not module.ispkg]
    found = {name.removesuffix(".__main__"): importlib.import_module(name) for name in names}
    return {name: module for name, module in found.items() if hasattr(module, "main")}


def hydra_commands() -> list[OptionCommand]:
    """Return the commands whose options Hydra composes."""
    return [module.COMMAND for module in modules().values() if hasattr(module, "COMMAND")]


def options_page(_: str = "") -> str:
    """Return every option of every command as tables: its default in each choice, and its meaning."""
    lines: list[str] = []
    for command in hydra_commands():
        config_class = command.config_class()
        config: Any = compose.compose_config(command.name, config_class, [])
        lines += [f"## python -m izoo.{command.name}", "", command.summary, ""]
        lines += _table(config_class, {"default": config}, "")
    for group, choices in compose.choices().items():
        lines += [f"## {group}=", ""]
        for config_class, presets in _by_class(group, choices).items():
            lines += [f"### {', '.join(f'`{group}={choice}`' for choice in presets)}", ""]
            lines += _table(config_class, presets, f"{group}.")
            for name, nested in _nested(next(iter(presets.values()))):
                lines += _table(type(nested), {"default": nested}, f"{group}.{name}.")
    return "\n".join(lines)


def _by_class(group: str, choices: tuple[str, ...]) -> dict[type, dict[str, Any]]:
    """Return the choices of a group, composed, by the dataclass that they fill."""
    found: dict[type, dict[str, Any]] = {}
    for choice in choices:
        config = options_of(group, choice)
        found.setdefault(type(config), {})[choice] = config
    return found


def options_of(group: str, choice: str) -> Any:
    """Return what ``group=choice`` stands for, composed by the first command that has such options.

    Raises:
        IzooError: no command has.
    """
    for command in hydra_commands():
        with contextlib.suppress(IzooError, AttributeError):
            config = getattr(compose.compose_config(command.name, command.config_class(), [f"{group}={choice}"]), group)
            # Commands have other defaults for the environment, which has one choice; the page shows its own.
            return type(config)() if choice == "default" else config
    raise IzooError(f"no command has the option {group}={choice}; izoo/conf has a file that nothing reads.")


def _nested(config: Any) -> Iterator[tuple[str, Any]]:
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield field.name, value


def _table(config_class: type, presets: dict[str, Any], prefix: str) -> list[str]:
    """Return a Markdown table: a row per option that is a value, a column per preset."""
    docs = option_docs(config_class)
    lines = [f"| option | {' | '.join(presets)} | meaning |", "|---" * (len(presets) + 2) + "|"]
    groups = compose.choices()
    for field in dataclasses.fields(config_class):
        values = [getattr(preset, field.name) for preset in presets.values()]
        if field.name == "name":
            continue
        if dataclasses.is_dataclass(values[0]):
            shown = [f"`{_choice(value)}`" if field.name in groups else "see below" for value in values]
            if field.name not in groups and not prefix:
                lines += _rows(f"{field.name}.", values[0])
                continue
        else:
            shown = [f"`{as_word(value)}`" for value in values]
        lines.append(f"| `{prefix}{field.name}` | {' | '.join(shown)} | {_meaning(docs, field.name)} |")
    return [*lines, ""]


def _rows(prefix: str, config: Any) -> list[str]:
    """Rows of a group of options that has no choices."""
    docs = option_docs(type(config))
    return [
        f"| `{prefix}{field.name}` | `{as_word(getattr(config, field.name))}` | {_meaning(docs, field.name)} |"
        for field in dataclasses.fields(config)
    ]


def _meaning(docs: dict[str, str], name: str) -> str:
    return html.escape(docs.get(name, ""), quote=False).replace("|", "\\|")


def _choice(config: Any) -> str:
    return str(getattr(config, "name", "default"))


def argparse_commands() -> dict[str, Callable[[list[str]], object]]:
    """Return the functions ``main`` of the commands that Hydra does not compose, by module name."""
    return {name: module.main for name, module in modules().items() if not hasattr(module, "COMMAND")}


def commands_page(_: str = "") -> str:
    """Return the help of every command that Hydra does not compose."""
    lines: list[str] = []
    for name, main in argparse_commands().items():
        page = help_of(main, [])
        lines += [f"## python -m {name}", "", "```text", page, "```", ""]
        for subcommand in subcommands(page):
            lines += [f"### {name.rpartition('.')[2]} {subcommand}", "", "```text"]
            lines += [help_of(main, [subcommand]), "```", ""]
    return "\n".join(lines)


def help_of(main: Callable[[list[str]], object], words: list[str]) -> str:
    """Return what ``--help`` prints."""
    out, columns = io.StringIO(), os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = HELP_COLUMNS
    try:
        with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
            main([*words, "--help"])
    finally:
        os.environ.pop("COLUMNS")
        if columns is not None:
            os.environ["COLUMNS"] = columns
    return out.getvalue().strip()


def subcommands(page: str) -> list[str]:
    """Return the subcommands that a help page lists in braces."""
    found = re.search(r"\{([\w,\n -]+)\} \.\.\.", page)
    return re.split(r",\s*", found.group(1)) if found else []


def source(path: str) -> str:
    """Return a file beside the pages as a block that folds out."""
    text = (FOLDER / path).read_text()
    body = "\n".join(f"    {line}".rstrip() for line in text.splitlines())
    return f'??? example "{path}"\n\n    ```python\n{body}\n    ```\n'


def observation_table(_: str = "") -> str:
    """Return the columns of an observation with default settings as a table."""
    config = EnvConfig()
    lines = ["| | column | unit | divided by | meaning |", "|---|---|---|---|---|"]
    for place, column in enumerate(observation_columns(config.neighbours, config.observed)):
        lines.append(f"| {place} | `{column.name}` | {column.unit} | {column.scale:g} | {column.meaning} |")
    return "\n".join(lines)


def reward_table(_: str = "") -> str:
    """Return the terms of the reward as a table."""
    lines = ["| column | unit | weight | default | in the vector |", "|---|---|---|---|---|"]
    for option, term in TERMS.items():
        where = "the smallest value, shared" if term.upper is not None else f"own, and `fleet_{term.name}`"
        weight = getattr(RewardConfig(), option)
        lines.append(f"| `{term.name}` | {term.unit} | `env.reward.{option}` | {weight:g} | {where} |")
    return "\n".join(lines)


MARKERS: dict[str, Callable[[str], str]] = {
    "options": options_page,
    "commands": commands_page,
    "source": source,
    "observation": observation_table,
    "reward": reward_table,
}
"""``<!-- options -->``, ``<!-- commands -->``, ``<!-- source: examples/NAME.py -->``, each alone on its line."""


def on_config(config: Any) -> Any:
    """Let mkdocstrings see the package as it is installed, although three of its folders lie beside it."""
    folder = Path(tempfile.mkdtemp(prefix="izoo-docs-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    package = folder / "izoo"
    package.mkdir()
    for entry in (ROOT / "izoo").iterdir():
        if entry.name != "__pycache__":
            (package / entry.name).symlink_to(entry)
    for name in ("envs", "algos", "benchmarks"):
        (package / name).symlink_to(ROOT / name)
    config.plugins["mkdocstrings"].config.handlers["python"]["paths"] = [str(folder)]
    return config


on_config.mkdocs_priority = 100  # type: ignore[attr-defined]  # before mkdocstrings reads its settings


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace markers by what they ask for."""
    return MARKER.sub(_fill, markdown)


def _fill(match: re.Match[str]) -> str:
    name, argument = match.groups()
    if name not in MARKERS:
        raise unknown_choice("marker", name, MARKERS)
    return MARKERS[name](argument or "")
