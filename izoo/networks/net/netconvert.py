"""``netconvert``: from plain XML to nets; most of a call is its start, so that many nets share one."""

from __future__ import annotations

import os
import re
import subprocess
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

from izoo.errors import IzooError
from izoo.networks.net.plain import PlainNet

SUMO_VERSION = "1.28.0"
TIMEOUT_S = 120.0
_OPTIONS = {
    "no-turnarounds": "true",
    "offset.disable-normalization": "true",
    "precision": "6",
    "xml-validation": "never",
}
_INPUTS = {"node-files": "nodes", "edge-files": "edges", "connection-files": "connections", "tllogic-files": "signals"}
_PLAIN_ID = re.compile(r'\b(id|from|to|tl)="')
_POINT = re.compile(r' x="(\S+)" y="(\S+)"')
_BETWEEN_ELEMENTS = re.compile(r"\n(?=    <\w)")
_NUMBER = re.compile(r'":?(\d+)/')


def convert(name: str, plain: PlainNet, scratch: Path) -> tuple[str, str]:
    """Return the net of ``plain``, and what netconvert said.

    Args:
        name: of the intersection, for messages.
        plain: the net as plain XML.
        scratch: a folder for its files.

    Raises:
        IzooError: netconvert refuses the net, does not end, or cannot be run.
    """
    return _run(name, {option: getattr(plain, field) for option, field in _INPUTS.items()}, scratch)


def convert_together(plains: Sequence[PlainNet], scratch: Path) -> list[str]:
    """Return the nets of ``plains``, each byte for byte as :func:`convert` returns it.

    All lie around the same origin, and their ids begin with their number: netconvert neither joins nor mixes them. It
    sorts elements by id, which leaves those of a net in their order.

    Raises:
        IzooError: netconvert refuses one of the nets, does not end, or cannot be run.
    """
    inputs = {}
    for option, field in _INPUTS.items():
        documents = [getattr(plain, field).splitlines() for plain in plains]
        opening, *_, closing = documents[0]
        elements = [_PLAIN_ID.sub(rf'\1="{number}/', "\n".join(lines[1:-1])) for number, lines in enumerate(documents)]
        inputs[option] = "\n".join([opening, *elements, closing, ""])
    text, _ = _run(f"1 of {len(plains)}", inputs, scratch)
    return _split(text, plains)


def _split(text: str, plains: Sequence[PlainNet]) -> list[str]:
    """Return the single nets; in each, an empty line stands between the kinds of elements that it has."""
    declaration, root, location, *kinds, end = text.split("\n\n")
    nets = [[declaration, root, _with_own_boundaries(location, plain)] for plain in plains]
    for kind in kinds:
        own: dict[int, list[str]] = defaultdict(list)
        for element in _BETWEEN_ELEMENTS.split(kind):
            own[int(_NUMBER.search(element)[1])].append(element)  # type: ignore[index]
        for number, elements in own.items():
            nets[number].append("\n".join(elements).replace(f"{number}/", ""))
    return ["\n\n".join([*parts, end]) for parts in nets]


def _with_own_boundaries(location: str, plain: PlainNet) -> str:
    """Return the element ``location`` with the box around the nodes of one net, to the sign of a zero."""
    # Of equal corners netconvert takes the last one; a zero loses its sign when it is moved by the offset.
    points = [(float(x), float(y)) for x, y in reversed(_POINT.findall(plain.nodes))]
    corners = [most(values) for most in (min, max) for values in zip(*points, strict=True)]
    for name, offset_m in (("convBoundary", 0.0), ("origBoundary", -0.0)):
        box = ",".join(f"{corner + offset_m:.6f}" for corner in corners)
        location = re.sub(f'{name}="[^"]*"', f'{name}="{box}"', location)
    return location


def _run(name: str, inputs: Mapping[str, str], scratch: Path) -> tuple[str, str]:
    """Run netconvert; return the net, without the header, and what it said."""
    try:
        import sumo
    except ImportError:
        raise IzooError(
            f"the net of intersection {name} is not in the cache, and building it needs SUMO, which is not installed; "
            f"run: pip install eclipse-sumo=={SUMO_VERSION}"
        ) from None
    command = [str(Path(sumo.SUMO_HOME, "bin", "netconvert"))]
    for option, text in inputs.items():
        (scratch / f"{option}.xml").write_text(text)
        command += [f"--{option}", f"{option}.xml"]
    command += [word for option, value in _OPTIONS.items() for word in (f"--{option}", value)]
    command += ["--output-file", "net.xml"]
    try:
        run = subprocess.run(
            command,
            cwd=scratch,
            env={**os.environ, "SUMO_HOME": sumo.SUMO_HOME},
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise IzooError(f"netconvert did not end within {TIMEOUT_S:g} s for intersection {name}.") from error
    except OSError as error:
        if not scratch.is_dir():
            raise IzooError(f"{scratch} was removed while a net was built there; do that again.") from error
        raise IzooError(f"cannot run {command[0]} ({error.strerror}); install the package eclipse-sumo.") from error
    messages = run.stderr.strip()
    result = scratch / "net.xml"
    if run.returncode != 0 or not result.is_file():
        raise IzooError(f"netconvert refuses intersection {name}: {messages or run.stdout.strip()}")
    # The header holds the date and the folder of the build; without it equal specs give equal files.
    return re.sub(r"<!--.*?-->\s*", "", result.read_text(), flags=re.DOTALL), messages
