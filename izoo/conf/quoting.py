"""Texts and values as Hydra's parser of command lines reads them back."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Any


def quoted(text: str) -> str:
    """Return a text in single quotes, in which only backslashes before a quote, and quotes, are written otherwise."""
    escaped = re.sub(r"(\\*)('|$)", lambda match: match[1] * 2 + ("\\'" if match[2] else ""), text)
    return f"'{escaped}'"


def written(value: Any, elsewhere: Collection[str] = (), name: str = "") -> str:
    """Return the value of an option as it is written on a command line.

    Args:
        value: plain numbers, switches, texts, lists and mappings.
        elsewhere: names of options whose places are of one machine: ``FOLDER`` stands for them.
        name: of the option.
    """
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{written(entry, elsewhere, key)}" for key, entry in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(written(entry, elsewhere) for entry in value) + "]"
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    if name in elsewhere:
        return "FOLDER"
    text = f"{value:.6g}" if isinstance(value, float) and float(f"{value:.6g}") == value else str(value)
    return text if re.fullmatch(r"[\w.+/-]+", text) else quoted(text)
