"""Texts as Hydra's parser of command lines reads them back."""

from __future__ import annotations

import re


def quoted(text: str) -> str:
    """Return a text in single quotes, in which only backslashes before a quote, and quotes, are written otherwise."""
    escaped = re.sub(r"(\\*)('|$)", lambda match: match[1] * 2 + ("\\'" if match[2] else ""), text)
    return f"'{escaped}'"


def literal(text: str) -> str:
    """Return :func:`quoted` of a text in which ``${...}`` stands for itself."""
    return quoted(re.sub(r"(\\*)\$\{", lambda match: match[1] * 2 + "\\${", text))
