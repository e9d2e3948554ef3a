"""Signal plans that are written by hand: into a town's ``KEY.json``, or into a file of them for ``--signals``.

A plan has the form of :class:`~izoo.contexts.spec.SignalPlan`::

    {"offset_s": 0, "phases": [{"duration_s": 30, "states": [["A", "C", "G"], ["C", "A", "G"], ["C", "B", "g"]]}, ...]}

Each state names the leg where a movement comes from, the one where it leads, and its colour; all others are red.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from izoo.contexts.movements import conflict
from izoo.contexts.spec import IntersectionSpec, SignalPhase, SignalPlan
from izoo.errors import IzooError
from izoo.files import expanded
from izoo.networks.net.connections import signal_links
from izoo.networks.net.programs import main_phases

IMPUTED = "signal plan"
"""The name under which an intersection lists that its plan is searched for."""
_FORM = '{"phases": [{"duration_s": 30, "states": [["A", "C", "G"], ...]}, ...], "offset_s": 0}'


def plan_from_dict(fields: Any, spec: IntersectionSpec) -> SignalPlan:
    """Read a plan, and check that the intersection ``spec`` can show it.

    Raises:
        IzooError: it has another form, a movement that no lane serves, one that is never green, or two that cross and
            are both shown a green with priority.
    """
    try:
        phases = tuple(
            SignalPhase(_number(phase["duration_s"]), tuple(_state(state) for state in phase["states"]))
            for phase in fields["phases"]
        )
        plan = SignalPlan(phases, _number(fields.get("offset_s", 0.0)))
        unknown = set(fields) - {"phases", "offset_s"}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise IzooError(
            f"a signal plan has the form {_FORM}; this one lacks or has something else ({error})."
        ) from None
    if unknown:
        raise IzooError(f"a signal plan has the form {_FORM}; this one has {sorted(unknown)[0]!r} as well.")
    main_phases(spec.name, plan, signal_links(spec))
    _check_crossings(spec, plan)
    return plan


def with_plan(spec: IntersectionSpec, fields: Any) -> IntersectionSpec:
    """Return the intersection with a plan, which is then not imputed; without one if ``fields`` is ``None``."""
    if fields is None:
        return spec
    imputed = tuple(name for name in spec.imputed if name != IMPUTED)
    return dataclasses.replace(spec, signal_plan=plan_from_dict(fields, spec), imputed=imputed)


def read_plans(path: Path | str) -> Mapping[str, Any]:
    """Read a JSON file of plans by the key of their intersection; they are checked when they are used.

    Raises:
        IzooError: the file is missing, or no JSON object.
    """
    path = expanded(path)
    try:
        found = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise IzooError(f"cannot read the signal plans {path}: {error.strerror}; give a JSON file.") from error
    except (ValueError, RecursionError) as error:
        raise IzooError(f"the signal plans {path} are not JSON ({error}).") from error
    if not isinstance(found, dict):
        raise IzooError(f'{path} holds no plans by intersection; write {{"KEY": {_FORM}}}.')
    return found


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{value!r} is not a number")
    return float(value)


def _state(state: Any) -> tuple[str, str, str]:
    start, end, colour = state
    if not all(isinstance(word, str) for word in (start, end, colour)):
        raise TypeError(f"{state!r} is not a movement and its colour")
    return start, end, colour


def _check_crossings(spec: IntersectionSpec, plan: SignalPlan) -> None:
    """Refuse two movements that cross and both have priority: their vehicles would collide."""
    bearings = {leg.name: leg.bearing_deg for leg in spec.legs}
    for number, phase in enumerate(plan.phases):
        first = [(start, end) for start, end, colour in phase.states if colour == "G"]
        for one, two in itertools.combinations(first, 2):
            ways = [(bearings[start], bearings[end]) for start, end in (one, two)]
            if one[1] != two[1] and conflict(*ways):
                raise IzooError(
                    f"intersection {spec.name}: phase {number} of its plan shows G to {one[0]} to {one[1]} and to "
                    f"{two[0]} to {two[1]}, which cross; show g to the one that yields."
                )
