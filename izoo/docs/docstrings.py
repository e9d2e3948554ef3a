"""How the API pages read docstrings: names that share a line become entries of their own, and roles become names."""

from __future__ import annotations

import re
from typing import Any

import griffe

SECTION = re.compile(r"^( *)(?:Args|Attributes):\n(?:\1 +.*\n?|\n)*", re.MULTILINE)
SHARED = re.compile(r"^( +)(\w+(?:, \w+)+)(: .*(?:\n\1 +\S.*)*)", re.MULTILINE)
"""An entry of a section that is of several names, with its further lines."""
ROLE = re.compile(r":(?:class|func|meth|attr|data|mod|exc):`~?([\w.]+)`")


class HouseStyle(griffe.Extension):
    """Rewrites every docstring before it is parsed."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called for everything that has a docstring."""
        if obj.docstring is not None:
            obj.docstring.value = rewrite(obj.docstring.value)


def rewrite(text: str) -> str:
    """Return a docstring with ``a, b: text`` as two entries, and ``:class:`~x.Y``` as ``Y`` in code type."""

    def apart(entry: re.Match[str]) -> str:
        return "\n".join(f"{entry[1]}{name}{entry[3]}" for name in entry[2].split(", "))

    text = SECTION.sub(lambda section: SHARED.sub(apart, section[0]), text)
    return ROLE.sub(lambda match: f"`{match[1].rpartition('.')[2]}`", text)
