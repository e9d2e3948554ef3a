"""What an evaluation found, in sentences."""

from __future__ import annotations

from typing import Any

from izoo.console import counted
from izoo.evaluation.policies import HUMAN, UNCOMMANDED
from izoo.metrics.statistics import MIN_INTERSECTIONS

AGAINST = {HUMAN: "human driving", UNCOMMANDED: "the same vehicles uncommanded"}


def in_words(summary: dict[str, Any], unseen: bool = False) -> str:
    """Return in a few sentences what the policy saves, how certain that is, and what it does to the throughput.

    Args:
        summary: what :func:`izoo.evaluation.summarise` returned, of one policy beside the baselines.
        unseen: whether the policy has been trained on none of these intersections.
    """
    (policy,) = (name for name in summary["policies"] if name not in AGAINST)
    count, against = (summary["policies"][policy][key] for key in ("intersections", "against"))
    found = {name: against[name]["all"] for name in AGAINST if name in against}
    savings = {name: blocks["ungated"]["mean"] for name, blocks in found.items()}
    if not savings or any(saving["value"] is None for saving in savings.values()):
        return "Nothing can be said of CO2: no vehicle crossed a stop line."
    parts = [f"{_amount(saving)} than {AGAINST[name]}" for name, saving in savings.items()]
    places = counted(count, "unseen intersection" if unseen else "intersection")
    lines = [f"On {places} vehicles emit {' and '.join(parts)}."]
    fallen = [name for name, blocks in found.items() if (blocks["throughput"]["mean"]["value"] or 0.0) < 0.0]
    if fallen:
        falls = [
            f"{-100.0 * found[name]['throughput']['mean']['value']:.1f} % fewer than under {AGAINST[name]}"
            for name in fallen
        ]
        lines.append(f"But fewer of them cross: {' and '.join(falls)}.")
    lines.append(_verdict(savings, count))
    return " ".join(lines)


def _amount(saving: dict[str, Any]) -> str:
    value, low, high = (saving[key] for key in ("value", "low", "high"))
    more = value < 0.0
    text = f"{100.0 * abs(value):.1f} %"
    if low is not None:
        ends = (-high, -low) if more else (low, high)
        text += f" [{100.0 * ends[0]:.1f}, {100.0 * ends[1]:.1f}]"
    return f"{text} {'more' if more else 'less'} CO2"


def _verdict(savings: dict[str, dict[str, Any]], intersections: int) -> str:
    if intersections < MIN_INTERSECTIONS:
        return "So few intersections say nothing about others."
    shown: dict[str, list[str]] = {"better": [], "worse": [], "open": []}
    for name, saving in savings.items():
        if saving["low"] is None:  # the same whichever intersection is left out
            kind = "open"
        else:
            kind = "better" if saving["low"] > 0.0 else "worse" if saving["high"] < 0.0 else "open"
        shown[kind].append(AGAINST[name])
    said = [f"{kind} than {' and than '.join(shown[kind])}" for kind in ("better", "worse") if shown[kind]]
    lines = [f"So the policy is {', and '.join(said)}; that is not chance (95 %)."] if said else []
    if shown["open"]:
        lines.append(f"Compared with {' and '.join(shown['open'])} no difference is shown.")
    return " ".join(lines)
