"""What stands on the shelf: names, files and cards. Nothing here loads PyTorch."""

from __future__ import annotations

from pathlib import Path

from izoo.errors import IzooError, unknown_choice

PREFIX = "zoo:"
"""``policy=zoo:NAME`` means the shipped policy ``NAME``."""
SHELF = Path(__file__).parent / "policies"
WEIGHTS, CARD = ".pt", ".md"


def names() -> tuple[str, ...]:
    """Return the names of the policies that ship, in order."""
    return tuple(sorted(path.stem for path in SHELF.glob(f"*{WEIGHTS}")))


def check_name(name: str) -> None:
    """Raise :class:`IzooError` unless a policy of this name ships."""
    if name not in names():
        raise unknown_choice("policy", PREFIX + name, [PREFIX + there for there in names()])


def named(policy: str) -> str | None:
    """Return the name in ``zoo:NAME``, or ``None`` where ``policy`` is not written so.

    Raises:
        IzooError: no policy of that name ships.
    """
    if not policy.startswith(PREFIX):
        return None
    name = policy.removeprefix(PREFIX)
    check_name(name)
    return name


def weights(name: str) -> Path:
    """Return the file that holds a shipped policy."""
    check_name(name)
    return SHELF / f"{name}{WEIGHTS}"


def card(name: str) -> str:
    """Return the card of a shipped policy, in Markdown: what it was trained on and how, what it did, its limits.

    Raises:
        IzooError: no policy of that name ships.
    """
    check_name(name)
    path = SHELF / f"{name}{CARD}"
    if not path.is_file():
        raise IzooError(f"the policy {name} has lost its card {path}; install izoo again.")
    return path.read_text(encoding="utf-8")
