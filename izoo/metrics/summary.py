"""What a table of episodes says: figures over intersections, differences between entries, and a verdict in words."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from izoo.errors import IzooError
from izoo.metrics.cell import Cell
from izoo.metrics.figures import FIGURES, HEADLINE
from izoo.metrics.pairing import (
    BASELINES,
    CONTEXT,
    HUMAN,
    UNCOMMANDED,
    Episodes,
    Paired,
    by_intersection,
    context_matrix,
    episodes_of,
    intersections_of,
    of_policy,
    pair,
    pair_in_episodes,
    simulators,
)
from izoo.metrics.statistics import (
    MIN_INTERSECTIONS,
    SIGNIFICANCE,
    Estimate,
    difference,
    estimate,
    holm,
    pooled,
    separate_difference,
    student,
    typical,
)

BLOCKS = ("unsaturated", "saturated", "all")
"""Kinds of contexts, the main one first; saturated is where volume exceeds capacity."""
TRAINING = ", training contexts"
"""Ends the name of the task under which contexts are played that policies were trained on."""
NOTABLE = 1.0
"""Per cent of CO2 from which an intersection counts as one that gains or loses."""
Summary = dict[str, Any]
Pairs = Mapping[str, Mapping[str, Paired]]
"""By policy and baseline."""


def summarise(table: pd.DataFrame, reference: str | None = None, trained_on: pd.DataFrame | None = None) -> Summary:
    """Sum up a table; plain values, ready for JSON (missing numbers are ``None``).

    Args:
        table: rows of episodes of policies, with those of baselines; of two simulators the one that played most counts.
        reference: an entry that the others are compared with; without one, all are compared pairwise.
        trained_on: rows of the same policies on contexts of their training.

    Returns:
        ``task``, ``simulators`` (the first is the one summed up), ``n`` (numbers of contexts, intersections, episode
        seeds per context and episodes; ``left_out``: names of contexts without demand), ``block`` (the main one),
        ``entries`` by policy, ``pairwise`` differences of CO2 saved, ``gaps`` by policy (the CO2 saved on ``training``
        contexts, and the generalisation ``gap``: how much more it is), ``cities`` (by city, where there are several,
        and policy: ``intersections`` and ``figures`` over uncommanded CVs), and ``verdict``, a sentence. An entry has
        ``train_seeds``; ``slower``: whether its delay is shown to be above that of uncommanded CVs; ``against`` by
        baseline and block: ``intersections``, ``contexts``, ``figures`` (:class:`~izoo.metrics.statistics.Estimate`),
        and of CO2 saved ``mean`` and ``median`` (per cent), ``gain_share`` and ``lose_share``; ``levels`` by block and
        figure: every vehicle weighs the same, counts are per context.

    Raises:
        IzooError: there are no rows, or a baseline lacks episodes of a policy.
    """
    if table.empty:
        raise IzooError("there are no episodes to sum up; evaluate a policy first.")
    played = simulators(table)
    rows = table[table["simulator"] == played[0]]
    without = rows.groupby("context_hash").agg(context=("context", "first"), cohort=("cohort", "sum"))
    left_out = without.loc[without["cohort"] <= 0.0, "context"].tolist()
    counted = rows[~rows["context_hash"].isin(without.index[without["cohort"] <= 0.0])]
    pairs = _pairs(rows)
    block = _main_block(counted)
    training = None if trained_on is None else trained_on[trained_on["simulator"] == played[0]]
    entries = {name: _entry(rows, name, pairs[name], block) for name in pairs}
    pairwise = _pairwise(rows, pairs, block, reference)
    return {
        "task": ", ".join(dict.fromkeys(str(task) for task in rows["task"] if task)),
        "simulators": played,
        "n": {
            "contexts": int(counted["context_hash"].nunique()),
            "intersections": int(counted["intersection"].nunique()),
            "eval_seeds": int(rows.groupby(["policy", "train_seed", "context_hash"])["seed"].nunique().max()),
            "episodes": len(rows[["policy", "train_seed", "context_hash", "seed"]].drop_duplicates()),
            "left_out": left_out,
        },
        "block": block,
        "entries": entries,
        "pairwise": pairwise,
        "gaps": {} if training is None else _gaps(pairs, _pairs(training), block),
        "cities": _cities(rows, pairs, block),
        "verdict": verdict(entries, pairwise, block),
    }


def verdict(entries: Mapping[str, Summary], pairwise: list[Summary], block: str) -> str:
    """Return in one sentence what an evaluation found: of several entries, what the best one saves and its margin.

    Args:
        entries, pairwise, block: as in :func:`summarise`.
    """
    compared = {name: entry for name, entry in entries.items() if name not in BASELINES and entry["against"]}
    compared = compared or {name: entry for name, entry in entries.items() if entry["against"]}
    if not compared:
        return "There is nothing to compare: the table has no policy with a baseline."
    values = {name: _headline(entry, block) for name, entry in compared.items()}
    ranked = [name for name, found in values.items() if found["value"] is not None]
    if not ranked:
        return "There is nothing to compare: no context has demand, or the baseline burns no CO2."
    ranked.sort(key=lambda name: (compared[name]["slower"], -values[name]["value"]))
    best = ranked[0]
    # Slower entries stand in a group of their own.
    group = [name for name in ranked if compared[name]["slower"] == compared[best]["slower"]]
    return f"{_in_words(best, compared[best], block)}{_margin(best, group, pairwise)}."


class _Words(NamedTuple):
    """How an estimate is said: the amount with its interval, and whether it is shown to be above or below 0."""

    amount: str
    shown: str


def _in_words(name: str, entry: Summary, block: str) -> str:
    """Say what one entry saves, and what it does to the delay."""
    baseline = next(iter(entry["against"]))
    found = entry["against"][baseline][block]
    saved, delay = (found["figures"][figure] for figure in ("co2_saved", "delay_change_s"))
    other = {UNCOMMANDED: "uncommanded CVs", HUMAN: "human driving"}[baseline]
    name = {UNCOMMANDED: "uncommanded driving"}.get(name, name)
    kind = "" if block == "all" else f"{block} "
    where = f"on {found['intersections']} {kind}intersection{'' if found['intersections'] == 1 else 's'}"
    where += ", over its episode seeds" if saved.get("over") == EPISODE_SEEDS else ""
    co2, time = _words(saved, "co2_saved"), _words(delay, "delay_change_s")
    slower = f"slower: {time.amount} more delay per vehicle" if time.shown == "above" else ""
    if co2.shown == "none":
        burns = saved["value"] < 0.0
        did = f"burns {co2.amount} more CO2 than" if burns else f"saves {co2.amount} CO2 over"
        few = found["intersections"] < MIN_INTERSECTIONS
        return f"{name} {did} {other} {where}" + (f", too few for an interval ({MIN_INTERSECTIONS})" if few else "")
    if co2.shown == "open":
        of = f"(CO2 saved {_number(saved, 'co2_saved')})"
        if slower:
            more = f"{time.amount} more delay per vehicle"
            return f"{name} is slower than {other} {where}: {more}; no CO2 saving is shown {of}"
        if time.shown == "below":
            return f"{name} saves {time.amount} of delay per vehicle over {other} {where}; no CO2 saving is shown {of}"
        return f"No difference between {name} and {other} is shown {where} {of}"
    faster = f", and saves {time.amount} of delay per vehicle" if time.shown == "below" else ""
    if co2.shown == "below":
        return f"{name} burns {co2.amount} more CO2 than {other} {where}{f', and is {slower}' if slower else faster}"
    tail = f", but is {slower}" if slower else faster or ", without more delay"
    return f"{name} saves {co2.amount} CO2 over {other} {where}{tail}"


def _margin(best: str, ranked: list[str], pairwise: list[Summary]) -> str:
    """Say how far the best entry is ahead of the second, or which ones it cannot be told from.

    Args:
        ranked: the best and those that it is to be compared with, by CO2 saved.
    """
    ahead = {found["y"]: (1.0, found) for found in pairwise if found["x"] == best}
    ahead |= {found["x"]: (-1.0, found) for found in pairwise if found["y"] == best}
    others = [name for name in ranked if name in ahead]
    alike = [name for name in others if ahead[name][1]["verdict"] == "indistinguishable"]
    if alike:
        listed = alike if len(alike) < 4 else [*alike[:2], f"{len(alike) - 2} more"]
        return f"; indistinguishable from {' and '.join(filter(None, (', '.join(listed[:-1]), listed[-1])))}"
    if not others:
        return ""
    sign, found = ahead[others[0]]
    difference = found["difference"]
    more = "more" if sign * difference["value"] > 0.0 else "less"
    return f"; {_words(difference, 'co2_saved', 'points').amount} {more} than {others[0]}"


def _words(found: Summary, figure: str, unit: str = "") -> _Words:
    """Say the size of an estimate, without its sign."""
    if found["value"] is None:
        return _Words("nothing", "none")
    sign = 1.0 if found["value"] >= 0.0 else -1.0
    size = {key: None if found[key] is None else sign * found[key] for key in ("value", "low", "high")}
    if sign < 0.0:
        size["low"], size["high"] = size["high"], size["low"]
    text = _number(size, figure, unit)
    if found["low"] is None:
        return _Words(text, "none" if abs(found["value"]) > 1e-9 else "open")
    return _Words(text, "above" if found["low"] > 0.0 else "below" if found["high"] < 0.0 else "open")


def _number(found: Summary, figure: str, unit: str = "") -> str:
    """An estimate with its unit, and its interval where it has one."""
    declared = FIGURES[figure]
    return str(Cell(found["value"], found["low"], found["high"], unit or declared.unit, declared.digits))


def _pairs(rows: pd.DataFrame) -> Pairs:
    """Pair each policy with the baselines that it is compared with."""
    names = list(dict.fromkeys(rows["policy"]))
    return {
        name: {other: pair(rows, name, other) for other in BASELINES if other in names and name not in (other, HUMAN)}
        for name in names
    }


def _main_block(counted: pd.DataFrame) -> str:
    saturated = counted.groupby("context_hash")["volume_over_capacity"].max() > 1.0
    return "all" if saturated.empty else "saturated" if saturated.all() else "unsaturated"


def _entry(rows: pd.DataFrame, name: str, pairs: Mapping[str, Paired], block: str) -> Summary:
    contexts, sums = of_policy(rows, name)
    levels = {}
    for kind, chosen in _blocks(contexts, (sums["cohort"] > 0).to_numpy()).items():
        mean = sums[chosen].mean().to_frame().T
        levels[kind] = {
            key: _plain(float(figure.value(mean, mean)[0])) for key, figure in FIGURES.items() if not figure.paired
        }
    against = {other: _against(paired, rows, name, other) for other, paired in pairs.items()}
    delay = against.get(UNCOMMANDED, {}).get(block, {}).get("figures", {}).get("delay_change_s", {}).get("low")
    return {
        "train_seeds": int(contexts["train_seed"].nunique()),
        "slower": bool(delay is not None and delay > 0.0),
        "against": against,
        "levels": levels,
    }


def _against(paired: Paired, rows: pd.DataFrame, name: str, baseline: str) -> Summary:
    """Compare by block; see :func:`summarise`."""
    values = {key: figure.value(paired.own, paired.baseline) for key, figure in FIGURES.items() if figure.paired}
    found = {}
    for kind, chosen in _blocks(paired.contexts).items():
        contexts = paired.contexts[chosen]
        pools = {key: by_intersection(contexts, value[chosen]) for key, value in values.items()}
        saved, n = pools["co2_saved"]
        figures = {key: estimate(pool) for key, (pool, _) in pools.items()}
        if paired.contexts["intersection"].nunique() == 1:
            over_episode_seeds(rows[rows["context_hash"].isin(contexts["context_hash"])], name, baseline, figures)
        found[kind] = {
            "intersections": saved.shape[1],
            "contexts": n,
            "figures": {key: each.to_dict() for key, each in figures.items()},
            "mean": _reduced(np.mean, saved),
            "median": _reduced(np.median, saved),
            "gain_share": _reduced(np.mean, saved > NOTABLE),
            "lose_share": _reduced(np.mean, saved < -NOTABLE),
        }
    return found


def _pairwise(rows: pd.DataFrame, pairs: Pairs, block: str, reference: str | None) -> list[Summary]:
    """Differences of CO2 saved between entries, over the contexts that both have.

    An entry of one training seed, or of none, is compared in the episodes of each training seed of the other; where it
    has not played them all, what it saves in the mean of its own is.
    """
    baselines = {name: next(iter(pairs[name])) for name in pairs if name not in BASELINES and pairs[name]}
    episodes = {name: episodes_of(rows, name) for name in baselines}
    saved = {name: context_matrix(*_saved(pairs[name][other], block)) for name, other in baselines.items()}

    @functools.cache
    def in_episodes(name: str, played: Episodes) -> pd.DataFrame:
        return context_matrix(*_saved(pair_in_episodes(rows, name, baselines[name], played), block))

    def ahead(x: str, y: str) -> Estimate:
        shared = saved[x].columns.intersection(saved[y].columns)
        sides, same_episodes = {x: saved[x], y: saved[y]}, False
        for own, other in ((x, y), (y, x)):
            if len(saved[own]) == 1:
                beside = in_episodes(own, episodes[other])
                if beside.index.equals(saved[other].index) and shared.isin(beside.columns).all():
                    sides[own], same_episodes = beside, True
        groups = intersections_of(pairs[x][baselines[x]].contexts, shared)
        a, b = (pooled(side[shared].to_numpy(), groups) for side in sides.values())
        return estimate(a - b) if same_episodes else difference(a, b)

    both = itertools.combinations(baselines, 2)
    compared = both if reference is None else [(name, reference) for name in baselines if name != reference]
    found = [(x, y, ahead(x, y)) for x, y in compared]
    corrected = holm([estimate.p for _, _, estimate in found])
    return [
        {"x": x, "y": y, "difference": each.to_dict(), "p_holm": _plain(p), "verdict": _told_apart(each.value, p)}
        for (x, y, each), p in zip(found, corrected, strict=True)
    ]


def _gaps(test: Pairs, training: Pairs, block: str) -> Summary:
    """By entry, the CO2 saved on training contexts, and how much more that is than on test contexts (points)."""
    found = {}
    for name in test:
        if name in BASELINES or not (test[name] and training.get(name)):
            continue
        sides = [next(iter(pairs[name].values())) for pairs in (training, test)]
        (there, _), (here, _) = (by_intersection(*_saved(paired, block)) for paired in sides)
        if there.size and here.size and len(there) == len(here):
            gap = separate_difference(there, here)
            found[name] = {"training": estimate(there).to_dict(), "gap": gap.to_dict()}
    return found


def _cities(rows: pd.DataFrame, pairs: Pairs, block: str) -> Summary:
    """By city, where there are several, and entry: number of intersections, and figures over uncommanded CVs."""
    of = rows.drop_duplicates("context_hash").set_index("context_hash")["city"].fillna("")
    found: Summary = {city: {} for city in sorted(set(of) - {""})}
    for name, compared in pairs.items():
        if name in BASELINES or UNCOMMANDED not in compared:
            continue
        contexts, own, baseline = compared[UNCOMMANDED]
        values = {key: FIGURES[key].value(own, baseline) for key in HEADLINE if FIGURES[key].paired}
        inside = _blocks(contexts).get(block, np.zeros(len(contexts), bool))
        for city in found:
            chosen = inside & (contexts["context_hash"].map(of) == city).to_numpy()
            pools = {key: by_intersection(contexts[chosen], value[chosen])[0] for key, value in values.items()}
            found[city][name] = {
                "intersections": int(contexts["intersection"][chosen].nunique()),
                "figures": {key: estimate(pool).to_dict() for key, pool in pools.items()},
            }
    return found if len(found) > 1 and all(found.values()) else {}


def _saved(paired: Paired, block: str) -> tuple[pd.DataFrame, np.ndarray]:
    """Contexts of a block, and the CO2 saved in each."""
    chosen = _blocks(paired.contexts).get(block, np.zeros(len(paired.contexts), bool))
    return paired.contexts[chosen], FIGURES["co2_saved"].value(paired.own, paired.baseline)[chosen]


def _told_apart(value: float, p: float) -> str:
    if not p < SIGNIFICANCE:
        return "indistinguishable"
    return "better" if value > 0.0 else "worse"


def _blocks(contexts: pd.DataFrame, counted: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Masks ``[N]`` of the rows of each block; those without rows are left out, but for ``all``."""
    saturated = contexts["saturated"].to_numpy(bool)
    counted = np.ones(len(contexts), bool) if counted is None else counted
    masks = dict(zip(BLOCKS, (counted & ~saturated, counted & saturated, counted), strict=True))
    return {kind: mask for kind, mask in masks.items() if kind == "all" or mask.any()}


def _headline(entry: Summary, block: str) -> Summary:
    """CO2 saved over the first baseline in the main block; its value is ``None`` where there is nothing."""
    against: Summary = next(iter(entry["against"].values()), {})
    return against[block]["figures"]["co2_saved"] if block in against else {"value": None}


def _reduced(statistic: Any, values: Any) -> float | None:
    return float(statistic(values)) if values.size else None


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None


EPISODE_SEEDS = "episode seeds"
MIN_EPISODE_SEEDS = 5
"""With fewer, no interval is given."""


def over_episode_seeds(table: pd.DataFrame, policy: str, baseline: str, found: dict[str, Estimate]) -> None:
    """Give estimates of a single intersection intervals over its episode seeds: there are no other intersections.

    They answer: what if other traffic had come to this very intersection, under these very weights? The figure is
    computed anew without each episode seed, of policy and baseline at once (the jackknife over paired seeds), and the
    interval is Student's. Of a difference of means it is the paired t interval.

    Nothing is changed where there are fewer than :data:`MIN_EPISODE_SEEDS`, or where contexts and training seeds were
    not all played with the same ones.

    Args:
        table: rows of that intersection, of one simulator.
        policy, baseline: whose figures are compared.
        found: estimates by figure; changed.
    """
    seeds = table.loc[table["policy"] == policy].groupby(CONTEXT)["seed"].agg(frozenset)
    every = sorted(seeds.iloc[0])
    if len(every) < MIN_EPISODE_SEEDS or seeds.nunique() > 1:
        return
    without = [pair(table[table["seed"] != seed], policy, baseline) for seed in every]
    for name, whole in found.items():
        figure, own = FIGURES[name], []
        for left in without:
            value = by_intersection(left.contexts, figure.value(left.own, left.baseline))[0]
            own.append(float(typical(value)) if value.size else math.nan)
        spread = math.sqrt((len(own) - 1) * float(np.var(own)))
        if spread > 0.0:
            found[name] = student(whole.value, spread, len(own) - 1, EPISODE_SEEDS)
