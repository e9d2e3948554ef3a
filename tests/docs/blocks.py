"""The code blocks of the documentation: found, told apart, and turned into what a test runs."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt

ROOT = Path(__file__).resolve().parent.parent.parent
DOCS = ROOT / "izoo" / "docs"
LANGUAGES = {"python", "bash", "text", "yaml"}
COMMENT = re.compile(r"<!-- (not run|run): (.+?) -->")


@dataclass(frozen=True)
class Block:
    """A fenced code block.

    Attributes:
        page: the file.
        line: of its first line of code, from 1.
        language: ``python`` is run, ``bash`` is checked line by line or run, ``text`` is what something prints.
        code: what is inside.
        not_run: why it is not run: the reason that the comment ``<!-- not run: REASON -->`` before it gives.
        run: toy sizes of ``<!-- run: OPTION=VALUE ... -->``: its commands are run with these options.
    """

    page: Path
    line: int
    language: str
    code: str
    not_run: str | None = None
    run: tuple[str, ...] | None = None


def pages() -> list[Path]:
    """Every page of Markdown that users read."""
    return [*sorted(DOCS.rglob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]


def blocks_of(page: Path, text: str | None = None) -> list[Block]:
    """Return the blocks of a page, in order.

    Raises:
        ValueError: a block says of no known language what it is, is indented instead of fenced, or gives no reason.
    """
    text = page.read_text() if text is None else text
    found: list[Block] = []
    comment = ""
    for token in MarkdownIt("commonmark").parse(text):
        line = (token.map or [0])[0] + 2
        if token.type == "html_block":
            comment = token.content
            continue
        if token.type == "code_block":
            raise ValueError(f"{page.name}:{line - 1}: an indented block; fence it, so that it says its language")
        if token.type == "fence":
            if token.info not in LANGUAGES:
                raise ValueError(f"{page.name}:{line}: language {token.info!r}; one of {sorted(LANGUAGES)}")
            found.append(_block(page, line, token.info, token.content, comment))
        comment = ""
    return found


def _block(page: Path, line: int, language: str, code: str, comment: str) -> Block:
    notes = dict(COMMENT.findall(comment))
    if "run:" in comment and not notes:
        raise ValueError(f"{page.name}:{line}: the comment {comment.strip()!r} gives no reason and no options")
    run = tuple(shlex.split(notes["run"])) if "run" in notes else None
    return Block(page, line, language, code, notes.get("not run"), run)


def command_lines(block: Block) -> list[list[str]]:
    """Return the commands of a bash block as words; settings of the shell (``NAME=value``) before them are left out."""
    joined = block.code.replace("\\\n", " ")
    commands = [shlex.split(line, comments=True) for line in joined.splitlines()]
    return [_without_settings(words) for words in commands if words]


def _without_settings(words: list[str]) -> list[str]:
    start = next((index for index, word in enumerate(words) if not re.fullmatch(r"[A-Z_]+=.*", word)), len(words))
    return words[start:]


def with_options(words: list[str], options: tuple[str, ...]) -> list[str]:
    """Return a command with some of its options replaced, or added."""
    names = {option.partition("=")[0] for option in options}
    return [word for word in words if word.partition("=")[0] not in names] + list(options)
