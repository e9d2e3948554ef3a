"""How the API pages read docstrings: names that share a line become entries of their own, and roles become names."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import griffe

SECTION = re.compile(r"( *)(Args|Attributes):")
SHARED = re.compile(r"( +)(\w+(?:, \w+)+)(: .*)")
ROLE = re.compile(r":(?:class|func|meth|attr|data|mod|exc):`~?([\w.]+)`")


class HouseStyle(griffe.Extension):
    """Rewrites every docstring before it is parsed."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called for everything that has a docstring."""
        if obj.docstring is not None:
            obj.docstring.value = rewrite(obj.docstring.value)


def rewrite(text: str) -> str:
    """Return a docstring with ``a, b: text`` as two entries, and ``:class:`~x.Y``` as ``Y`` in code type."""
    lines: list[str] = []
    for is_entry, group in _groups(text.splitlines()):
        head = SHARED.fullmatch(group[0]) if is_entry else None
        if head is None:
            lines += group
        else:
            indent, names, meaning = head.groups()
            for name in names.split(", "):
                lines += [f"{indent}{name}{meaning}", *group[1:]]
    return ROLE.sub(lambda match: f"`{match.group(1).rpartition('.')[2]}`", "\n".join(lines))


def _groups(lines: list[str]) -> Iterator[tuple[bool, list[str]]]:
    """Yield the entries of the sections, each with its further lines, and every other line by itself."""
    section = None  # indentation of the section that is being read
    group: list[str] = []
    for line in lines:
        indent = len(line) - len(line.lstrip())
        if group and (not line.strip() or indent <= len(section or "") + 4):
            yield True, group
            group = []
        if section is not None and line.strip() and indent <= len(section):
            section = None
        heading = SECTION.fullmatch(line)
        if heading:
            section = heading.group(1)
        if group:
            group.append(line)
        elif section is not None and not heading and indent == len(section) + 4:
            group = [line]
        else:
            yield False, [line]
    if group:
        yield True, group
