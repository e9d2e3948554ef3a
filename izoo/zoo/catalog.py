"""Shipped policies, and policies in files of one's own: names, files and cards. Nothing here loads PyTorch."""

from __future__ import annotations

from pathlib import Path

from izoo.errors import IzooError, unknown_choice
from izoo.files import expanded

PREFIX = "zoo:"
"""``policy=zoo:NAME`` means the shipped policy ``NAME``."""
FOLDER = Path(__file__).parent / "policies"
WEIGHTS, CARD = ".pt", ".md"
EXPORT = "python -m izoo.zoo export"
"""The command that writes the policy of a run as a file."""


def names() -> tuple[str, ...]:
    """Return the names of the policies that ship, in order."""
    return tuple(sorted(path.stem for path in FOLDER.glob(f"*{WEIGHTS}")))


def named(policy: str) -> str | None:
    """Return what :func:`izoo.zoo.load` takes: the name in ``zoo:NAME``, or the path of a file ``NAME.pt`` that
    ``python -m izoo.zoo export`` wrote.

    ``None`` where ``policy`` is written otherwise, or is a checkpoint of a run.

    Raises:
        IzooError: no policy of that name ships, or the file is missing.
    """
    if policy.startswith(PREFIX):
        return weights(policy.removeprefix(PREFIX)).stem
    path = expanded(policy)
    if path.suffix != WEIGHTS or path.is_dir() or path.parent.name == "checkpoints":
        return None
    if not path.is_file():
        raise IzooError(f"there is no file {path}; give one that {EXPORT} wrote.")
    return str(path)


def absolute(policy: str) -> str:
    """Return ``policy``, a file ``NAME.pt`` with its whole path, so that it means the same in any folder."""
    is_file = not policy.startswith(PREFIX) and Path(policy).suffix == WEIGHTS
    return str(expanded(policy).absolute()) if is_file else policy


def weights(name: str) -> Path:
    """Return the file that holds a shipped policy.

    Raises:
        IzooError: no policy of that name ships.
    """
    if name not in names():
        raise unknown_choice("policy", PREFIX + name, [PREFIX + there for there in names()])
    return FOLDER / f"{name}{WEIGHTS}"


def card(name: str) -> str:
    """Return the card of a shipped policy, in Markdown: what it was trained on and how, what it did, its limits."""
    return weights(name).with_suffix(CARD).read_text(encoding="utf-8")
