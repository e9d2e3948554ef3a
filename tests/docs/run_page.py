"""Runs a page: its Python blocks one after the other in this process, its shell commands checked, or run at toy size.

``python -m tests.docs.run_page PAGE``; an exception names the page and the line.
"""

import argparse
import contextlib
import importlib
import inspect
import io
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from izoo.__main__ import COMMANDS
from izoo.cli.option_command import OptionCommand, combinations, compose_config
from tests.docs.blocks import ROOT, Block, blocks_of, command_lines, with_options


class Understood(Exception):
    """A command has read its arguments and would now begin."""


def run_page(page: Path) -> int:
    """Run the blocks of a page in order; return how many there were."""
    blocks = [block for block in blocks_of(page) if block.language in ("python", "bash") and block.not_run is None]
    namespace: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks:
        if block.language == "python":
            # As many lines before it as in the page, so that a traceback names the page's own line.
            code = compile("\n" * (block.line - 1) + block.code, str(page), "exec")
            exec(code, namespace)
        else:
            run_commands(block)
    return len(blocks)


def run_commands(block: Block) -> None:
    """Check every command of a block, and run them where the page says so."""
    for words in command_lines(block):
        try:
            check_command(words)
        except Exception as error:
            raise ValueError(f"{block.page.name}:{block.line}: {' '.join(words)}: {error}") from error
        if block.run is not None:
            command = with_options(words, block.run)
            command[0] = sys.executable if command[0] == "python" else command[0]
            subprocess.run(command, check=True)


def check_command(words: list[str]) -> None:
    """Raise unless a command would begin its work with these words."""
    if words[:2] == ["python", "-m"] and words[2].startswith("izoo."):
        _check_izoo(words[2], words[3:])
    elif words[0] == "make":
        makefile = (ROOT / "Makefile").read_text()
        for word in words[1:]:
            if "=" not in word and not re.search(rf"^{re.escape(word)}:", makefile, re.MULTILINE):
                raise ValueError(f"the Makefile has no target {word!r}")
    elif words[0] == "izoo" and set(words[1:2]) <= set(COMMANDS):
        return
    elif words[:2] == ["pip", "install"]:
        project = (ROOT / "pyproject.toml").read_text()
        for extra in re.findall(r"izoo\[([\w,]+)\]", " ".join(words)):
            for name in extra.split(","):
                if not re.search(rf"^{name} = \[", project, re.MULTILINE):
                    raise ValueError(f"there is no extra {name!r}")
    else:
        raise ValueError("nobody knows how to check this; mark the block <!-- not run: REASON -->")


def _check_izoo(module_name: str, words: list[str]) -> None:
    """Let the command itself read its words, up to where it would begin."""
    module = importlib.import_module(module_name)
    if not hasattr(module, "main"):
        module = importlib.import_module(f"{module_name}.__main__")
    command = getattr(module, "COMMAND", None)
    if isinstance(command, OptionCommand):
        options = command.named([word for word in words if not word.startswith("-")])
        for combination in combinations(options) if "-m" in words else [options]:
            compose_config(command.config_class(), combination)
        return
    if module_name.startswith("izoo.docs.examples."):
        inspect.signature(module.main).bind(*words)  # tests/test_examples.py runs it
        return
    parse = argparse.ArgumentParser.parse_args

    def parse_and_stop(parser: argparse.ArgumentParser, args: Any = None, namespace: Any = None) -> None:
        parse(parser, args, namespace)
        raise Understood

    complaint = io.StringIO()
    argparse.ArgumentParser.parse_args = parse_and_stop  # type: ignore[method-assign, assignment]
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(complaint):
            module.main(words)
    except Understood:
        return
    except SystemExit as stop:
        raise ValueError(f"refused: {complaint.getvalue().strip().splitlines()[-1:]} ({stop.code})") from None
    finally:
        argparse.ArgumentParser.parse_args = parse  # type: ignore[method-assign]
    raise ValueError("the command never read its arguments")


if __name__ == "__main__":
    os.environ.setdefault("WANDB_MODE", "offline")
    print(run_page(Path(sys.argv[1])), "blocks")
