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
import re
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from izoo import tasks
from izoo.__main__ import COMMANDS
from izoo.cli.help_page import attribute_docs
from izoo.cli.option_command import OptionCommand
from izoo.conf.choices import groups
from izoo.envs.config import EnvConfig, RewardConfig
from izoo.envs.mdp.observation import observation_columns
from izoo.envs.mdp.reward import TERMS
from izoo.errors import unknown_choice
from izoo.options import to_mapping, written

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parent.parent
MARKER = re.compile(r"^<!-- (options|commands|tasks|source|observation|reward)(?:: (\S+))? -->$", re.MULTILINE)
HELP_COLUMNS = "100"


def modules() -> dict[str, Any]:
    """Return the modules that ``python -m`` runs, by the name that it takes."""
    return {module.removesuffix(".__main__"): importlib.import_module(module) for module, _ in COMMANDS.values()}


def hydra_commands() -> list[OptionCommand]:
    """Return the commands whose options are words that Hydra parses."""
    return [module.COMMAND for module in modules().values() if hasattr(module, "COMMAND")]


def options_page(_: str = "") -> str:
    """Return every option of every command as tables: its default in each choice, and its meaning."""
    lines: list[str] = []
    for command in hydra_commands():
        config_class = command.config_class()
        lines += [f"## python -m izoo.{command.name}", "", command.summary, ""]
        lines += _table(config_class, {"default": config_class()}, "")
    for group, choices in groups().items():
        lines += [f"## {group}=", ""]
        for config_class, presets in _by_class(choices).items():
            lines += [f"### {', '.join(f'`{group}={choice}`' for choice in presets)}", ""]
            lines += _table(config_class, presets, f"{group}.")
    return "\n".join([*lines, "## env", "", *_table(EnvConfig, {"default": EnvConfig()}, "env.")])


def _by_class(choices: Mapping[str, Callable[[], Any]]) -> dict[type, dict[str, Any]]:
    """Return the choices of a group by the dataclass that they fill."""
    found: dict[type, dict[str, Any]] = {}
    for choice, make in choices.items():
        config = make()
        found.setdefault(type(config), {})[choice] = config
    return found


def _table(config_class: type, presets: dict[str, Any], prefix: str) -> list[str]:
    """Return a Markdown table: a row per option that is a value, a column per preset."""
    docs = attribute_docs(config_class)
    lines = [f"| option | {' | '.join(presets)} | meaning |", "|---" * (len(presets) + 2) + "|"]
    for field in dataclasses.fields(config_class):
        path, values = f"{prefix}{field.name}", [getattr(preset, field.name) for preset in presets.values()]
        if field.name == "name":
            continue
        if dataclasses.is_dataclass(values[0]) and path not in groups() and path != "env":
            lines += _rows(f"{path}.", values[0])
            continue
        shown = [
            getattr(value, "name", "see below") if dataclasses.is_dataclass(value) else _word(value) for value in values
        ]
        lines.append(f"| `{path}` | {' | '.join(f'`{text}`' for text in shown)} | {_meaning(docs, field.name)} |")
    return [*lines, ""]


def _rows(prefix: str, config: Any) -> list[str]:
    """Rows of a group of options that has no choices."""
    docs = attribute_docs(type(config))
    return [
        f"| `{prefix}{field.name}` | `{_word(getattr(config, field.name))}` | {_meaning(docs, field.name)} |"
        for field in dataclasses.fields(config)
    ]


def _word(value: Any) -> str:
    """Return a value as it is written; a group of options has a table of its own."""
    return getattr(value, "name", "see below") if dataclasses.is_dataclass(value) else written(to_mapping(value))


def tasks_table(_: str = "") -> str:
    """Return the tasks as a table."""
    lines = ["| task | asks | known to learn there |", "|---|---|---|"]
    return "\n".join(
        [*lines, *(f"| `{name}` | {task.about} | {task.learns} |" for name, task in tasks.tasks().items())]
    )


def _meaning(docs: dict[str, str], name: str) -> str:
    return html.escape(docs.get(name, ""), quote=False).replace("|", "\\|")


def argparse_commands() -> dict[str, Callable[[list[str]], object]]:
    """Return the functions ``main`` of the commands with subcommands, by module name."""
    return {name: module.main for name, module in modules().items() if not hasattr(module, "COMMAND")}


def commands_page(_: str = "") -> str:
    """Return the help of every command with subcommands."""
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
    "tasks": tasks_table,
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
