"""What ``python -m izoo.zoo`` does: list and show the trained policies that ship, and export one from a run."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import Any

from izoo import __version__
from izoo.cli.subcommands import SubcommandCommand, argument
from izoo.console import survives_lost_output
from izoo.errors import IzooError
from izoo.files import check_folder, write_text
from izoo.options import written
from izoo.zoo import catalog

LOCAL_PATHS = ("path", "drivers", "start")
"""Options that name a place on one machine."""
OMITTED = (
    *("run_dir", "resume", "num_workers", "device", "logger", "checkpoint", "validation", "evaluation", "env.emit"),
)
"""Options of a run that have no part in what was learned."""


ZOO = SubcommandCommand("zoo", "Trained policies that ship with izoo.")


@ZOO.command("list the policies")
def _list(_: argparse.Namespace) -> None:
    """Print each policy with the first sentence of its card."""
    for name in catalog.names():
        print(f"{name}: {_first_sentence(catalog.card(name))}")
    print("One of them: python -m izoo.zoo show NAME, python -m izoo.evaluate policy=zoo:NAME", flush=True)


def _first_sentence(card: str) -> str:
    text = " ".join(card.split("\n\n")[1].split())
    return text if ". " not in text else text[: text.index(". ") + 1]


@ZOO.command(
    "print the card of a policy",
    argument("name", help="one of python -m izoo.zoo list, with or without zoo: before it"),
)
def _show(options: argparse.Namespace) -> None:
    print(catalog.card(options.name.removeprefix(catalog.PREFIX)).strip(), flush=True)


@ZOO.command(
    "write a run's policy as one file, with a card",
    argument("folder", type=Path, help="the folder of a training run"),
    argument("--out", type=Path, required=True, help="the new file NAME.pt; its card NAME.md goes beside it"),
    argument("--checkpoint", default="last", help="last, best, or a number of frames"),
    argument("--evaluation", type=Path, help="a folder of izoo.evaluate, whose figures go on the card"),
)
@survives_lost_output()
def _export(options: argparse.Namespace) -> None:
    """Write the policy of a run as one file, and a card with what is known of it."""
    out = options.out
    if out.suffix != catalog.WEIGHTS or not out.parent.is_dir():
        raise IzooError(f"--out is {out}; name a file that ends in {catalog.WEIGHTS}, in a folder that exists.")
    card = out.with_suffix(catalog.CARD)
    for path in (out, card):
        if path.exists():
            raise IzooError(f"{path} exists already; choose another name, or remove it.")
    if options.evaluation is not None:
        check_folder(options.evaluation, "give one that izoo.evaluate has written")
    print(f"izoo {__version__} zoo: reading {options.folder}", flush=True)
    from izoo.training import checkpoint, run_folder
    from izoo.zoo import trained

    path = checkpoint.find(options.folder, options.checkpoint)
    algorithm, config, state = run_folder.load_algorithm(path)
    text = _card(out.stem, config, state["frames"], options.evaluation)
    trained.write(out, config, algorithm.policy)
    write_text(card, text)
    print(f"Policy: {out}\nCard, to be completed: {card}")
    print(f"Play it: python -m izoo.evaluate policy={out}", flush=True)


def _card(name: str, config: Any, frames: int, evaluation: Path | None) -> str:
    """Return a card with what the run and the evaluation know."""
    command = " ".join(["python -m izoo.train", *_changed(config)])
    lines = [f"# {name}", "", f"{config.algo.name.upper()}, trained on {config.contexts.name}.", "", "## Trained", ""]
    lines += [f"izoo {__version__}, {frames:,} environment steps on {config.simulator}:", "", "```bash", command, "```"]
    lines += ["", "## Evaluated", "", *_figures(evaluation)]
    lines += [
        "",
        "## Intended use and limits",
        "",
        "Research on eco-driving in simulation. It has not been made for roads.",
    ]
    return "\n".join([*lines, "", "## Licence", "", "As izoo.", ""])


def _changed(config: Any) -> list[str]:
    """Return the options of a run that are not the defaults, as they are written on a command line."""
    from izoo.cli.option_command import compose_config
    from izoo.conf.train_options import TrainConfig
    from izoo.options import to_mapping

    words = [] if config.task is None else [f"task={config.task}"]
    words += [f"{group}={getattr(config, group).name}" for group in ("algo", "action", "contexts")]
    default = compose_config(TrainConfig, words)
    return [*words, *_differences(to_mapping(config), to_mapping(default))]


def _differences(values: dict[str, Any], default: Any, prefix: str = "") -> list[str]:
    found = []
    for name, value in values.items():
        path, was = f"{prefix}{name}", default.get(name) if isinstance(default, dict) else None
        if path in OMITTED or value == was:
            continue
        if isinstance(value, dict) and isinstance(was, dict):
            found += _differences(value, was, f"{path}.")
        else:
            found.append(shlex.quote(f"{path}={written(value, LOCAL_PATHS, name)}"))
    return found


def _figures(evaluation: Path | None) -> list[str]:
    """Return the figures of a folder of results in Markdown."""
    if evaluation is None:
        return ["Not yet."]
    from izoo.metrics.summary import summarise
    from izoo.report.tables import markdown
    from izoo.results.store import read_table

    return [markdown(summarise(read_table(evaluation))).rstrip()]
