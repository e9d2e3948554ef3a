"""How far the twin is from SUMO: per approach, per policy, and in what policies gain."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.box import SIMPLE_HEAD
from rich.table import Table

from izoo.benchmarks.conduct import COUNTS, rates
from izoo.evaluation.policies import HUMAN
from izoo.files import replacing
from izoo.metrics.benefit import benefits

MEASURES = {
    "co2_g": ("emission_g", "crossed"),
    "crossed": ("crossed", None),
    "travel_time_s": ("travel_time_s", "crossed"),
    "stopped_s": ("stopped_time_s", "crossed"),
}
"""What is compared per approach: a sum, over a count or (``None``) over episodes."""
_PAIR = ["policy", "context", "context_hash", "approach"]
KEY = ["policy", "adoption", "demand", "context", "context_hash", "approach"]
GROUP = ["policy", "adoption", "demand", "lanes"]
"""What approaches are summed up by."""
COUNTED = tuple(f"{name}_{side}" for side in ("sumo", "twin") for name in COUNTS)
"""What is counted of drivers in an episode, on each side."""
WIDE = 0.05
"""Differences of CO2 above this, beyond SUMO's own spread, are named."""


def approaches(sumo: pd.DataFrame, other: pd.DataFrame, side: str = "twin") -> pd.DataFrame:
    """Compare two evaluations of the same contexts and seeds, a row per policy and approach.

    Human driving is compared once for each intersection and demand, as no CVs, whatever the context's share of them.

    Args:
        sumo, other: tables as ``izoo.evaluate`` writes them.
        side: what the other one is called.

    Returns:
        :data:`KEY`, ``seeds``, ``lane_count``, and per measure ``*_sumo``, ``*_twin`` (means over seeds) and
        ``*_difference`` (relative to SUMO; of crossed vehicles too). Approaches that nobody crosses in SUMO have no
        differences (NaN).
    """
    about = ["adoption", "demand", "lane_count"]
    joined = sumo.merge(other.drop(columns=about), on=[*_PAIR, "seed"], suffixes=("_sumo", f"_{side}"), validate="1:1")
    rows = []
    for key, group in joined.groupby(KEY, sort=False):
        row: dict[str, Any] = dict(zip(KEY, key, strict=True)) | {"seeds": len(group)}
        row["lane_count"] = int(group["lane_count"].iloc[0])
        for name, (total, count) in MEASURES.items():
            centre = {name: _mean(_per_seed(group, total, count, name)) for name in ("sumo", side)}
            row |= {f"{name}_{played}": value for played, value in centre.items()}
            row[f"{name}_difference"] = centre[side] / centre["sumo"] - 1.0 if centre["sumo"] else np.nan
        rows.append(row)
    table = pd.DataFrame(rows)
    human = table["policy"] == HUMAN
    table.loc[human, "adoption"] = 0.0
    # Contexts that differ in the share of CVs alone have one name, and the same human driving.
    again = table.duplicated([name for name in KEY if name != "context_hash"])
    return table[~(human & again)].reset_index(drop=True)


def own_spread(sumo: pd.DataFrame, late: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Compare SUMO with itself: :func:`approaches` for each evaluation with late vehicles, one below the other."""
    tables = [approaches(sumo, table, "late").assign(late=number) for number, table in enumerate(late, 1)]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def with_spread(compared: pd.DataFrame, own: pd.DataFrame) -> pd.DataFrame:
    """Add to :func:`approaches` SUMO's own spread, ``co2_g_own`` and ``crossed_own``.

    It is the mean size of the relative differences of :func:`own_spread`; NaN where it was not measured.
    """
    names = {f"{name}_difference": f"{name}_own" for name in ("co2_g", "crossed")}
    if own.empty:
        return compared.assign(**dict.fromkeys(names.values(), np.nan))
    sizes = own[[*KEY, *names]].rename(columns=names)
    sizes[list(names.values())] = sizes[list(names.values())].abs()
    return compared.merge(sizes.groupby(KEY, sort=False).mean().reset_index(), on=KEY, how="left", validate="1:1")


def _per_seed(group: pd.DataFrame, total: str, count: str | None, side: str) -> np.ndarray:
    sums = group[f"{total}_{side}"].to_numpy(float)
    if count is None:
        return sums
    counts = group[f"{count}_{side}"].to_numpy(float)
    return np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0)


def _mean(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else np.nan


def few(table: pd.DataFrame) -> pd.DataFrame:
    """Sum up episodes of one and two vehicles, a row per number of vehicles, and commanded or not.

    Args:
        table: a row per episode, as :func:`izoo.benchmarks.few_vehicles.compare_few` returns them.
    """
    if table.empty:
        return pd.DataFrame()
    groups = table.groupby(["vehicles", "commanded"], sort=True)
    summed = groups["parted"].agg(episodes="size", same=lambda parted: int(parted.isna().sum()))
    return summed.reset_index()


def conduct(exact: pd.DataFrame) -> pd.DataFrame:
    """Sum up what drivers did, a row per policy, demand and measure, with its value in SUMO and on the twin.

    Measures are those of :func:`izoo.benchmarks.conduct.rates`, then :data:`izoo.benchmarks.conduct.COUNTS`.

    Args:
        exact: a row per episode, as :func:`izoo.benchmarks.twin.compare_steps` returns them; those in which nobody
            counted are left out.
    """
    exact = exact.dropna(subset=list(COUNTED))
    if exact.empty:
        return pd.DataFrame()
    rows = []
    for key, group in exact.groupby(["policy", "demand"], sort=False):
        about = dict(zip(("policy", "demand"), key, strict=True))
        counts = {side: {name: float(group[f"{name}_{side}"].sum()) for name in COUNTS} for side in ("sumo", "twin")}
        found = {side: rates(of) | of for side, of in counts.items()}
        rows += [about | {"measure": name} | {side: found[side][name] for side in found} for name in found["sumo"]]
    return pd.DataFrame(rows)


def exactness(exact: pd.DataFrame) -> pd.DataFrame:
    """Sum up episodes that were compared step by step, a row per policy, demand and kind of approach.

    Args:
        exact: a row per episode, as :func:`izoo.benchmarks.twin.compare_steps` returns them.
    """
    if exact.empty:
        return pd.DataFrame()
    kinds = np.where(exact["lanes"] == 1, "one lane", "several lanes")
    rows = []
    for key, group in exact.assign(kind=kinds).groupby(["policy", "demand", "kind"], sort=False):
        parted = group["parted"].dropna()
        rows.append(
            dict(zip(("policy", "demand", "kind"), key, strict=True))
            | {
                "episodes": len(group),
                "same": len(group) - len(parted),
                "median_parted": float(parted.median()) if len(parted) else np.nan,
                "ks_speed": float(group["ks_speed"].mean()),
                "ks_accel": float(group["ks_accel"].mean()),
            }
        )
    return pd.DataFrame(rows)


def rungs(table: pd.DataFrame, side: str = "twin") -> pd.DataFrame:
    """Sum :func:`approaches` up, a row per policy, share of CVs, demand and kind of approach (one lane, several).

    ``co2_beyond`` counts approaches whose CO2 differs by more than :data:`WIDE` beyond SUMO's own spread, where the
    table has it (:func:`with_spread`); ``co2_wide`` those that differ by more than that in any case.
    """
    kinds = np.where(table["lane_count"] == 1, "one", "several")
    rows = []
    for key, group in table.assign(lanes=kinds).groupby(GROUP, sort=False):
        away = group["co2_g_difference"].abs()
        own = {name: group.get(f"{name}_own", pd.Series(dtype=float)) for name in ("co2_g", "crossed")}
        beyond = away - own["co2_g"].reindex(group.index).fillna(0.0) > WIDE
        rows.append(
            dict(zip(GROUP, key, strict=True))
            | {
                "approaches": int(away.notna().sum()),
                "co2_mean_abs": float(away.mean()),
                "co2_bias": float(group["co2_g_difference"].mean()),
                "co2_median_abs": float(away.median()),
                "co2_worst": float(away.max()),
                "co2_wide": int((away > WIDE).sum()),
                "co2_beyond": int(beyond.sum()),
                "co2_own": float(own["co2_g"].mean()),
                "crossed": _change(group, "crossed", side),
                "crossed_mean_abs": float(group["crossed_difference"].abs().mean()),
                "crossed_own": float(own["crossed"].mean()),
                "travel_time": float(group["travel_time_s_difference"].mean()),
                "stopped": _change(group, "stopped_s", side),
            }
        )
    return pd.DataFrame(rows)


def _change(group: pd.DataFrame, name: str, side: str) -> float:
    """Return by how much larger a measure is than in SUMO, summed over approaches; NaN where it is 0 there."""
    sumo, other = (float(group[f"{name}_{played}"].sum()) for played in ("sumo", side))
    return other / sumo - 1.0 if sumo else np.nan


def gains(sumo: pd.DataFrame, twin: pd.DataFrame, late: Sequence[pd.DataFrame] = ()) -> pd.DataFrame:
    """Return what policies gain over human driving, in SUMO and on the twin, a row per policy, share of CVs and demand.

    Args:
        sumo, twin: tables as ``izoo.evaluate`` writes them.
        late: of SUMO with late vehicles.

    Returns:
        ``policy``, ``adoption``, ``demand``; the mean benefit, ungated, in ``sumo`` and on the ``twin``, over
        approaches that have one (NaN where none has), their ``difference``, and ``own``: the mean size of the
        difference that late vehicles make in SUMO (NaN without).
    """
    rows = []
    for policy in [name for name in sumo["policy"].unique() if name != HUMAN]:
        for (adoption, demand), _ in sumo[sumo["policy"] == policy].groupby(["adoption", "demand"], sort=True):

            def gain(table: pd.DataFrame) -> float:
                part = table[(table["adoption"] == adoption) & (table["demand"] == demand)]  # noqa: B023
                chosen, human = (part[part["policy"] == name] for name in (policy, HUMAN))  # noqa: B023
                compared = benefits(chosen, human)
                return float(compared.loc[compared["left_out"] == "", "benefit_ungated"].mean())

            found = {"sumo": gain(sumo), "twin": gain(twin)}
            own = [abs(gain(table) - found["sumo"]) for table in late]
            rows.append(
                {"policy": policy, "adoption": adoption, "demand": demand}
                | {**found, "difference": found["twin"] - found["sumo"], "own": float(np.mean(own)) if own else np.nan}
            )
    return pd.DataFrame(rows)


def same_order(gained: pd.DataFrame) -> bool:
    """Whether policies that gain or lose anything rank the same on both, at every share of CVs, with every demand."""
    gained = gained.dropna(subset=["sumo", "twin"]) if len(gained) else gained
    groups = gained.groupby(["adoption", "demand"]) if len(gained) else ()
    return all(bool((group["sumo"].rank() == group["twin"].rank()).all()) for _, group in groups)


def ks_distance(one: np.ndarray, other: np.ndarray) -> float:
    """Return the Kolmogorov-Smirnov distance of two histograms over the same bins; NaN where one is empty."""
    if not one.sum() or not other.sum():
        return float("nan")
    return float(np.abs(np.cumsum(one) / one.sum() - np.cumsum(other) / other.sum()).max())


class Ladder(NamedTuple):
    """What was found; tables that were not measured are empty.

    Attributes:
        few, exact, conduct: of :func:`few`, :func:`exactness` and :func:`conduct`.
        rungs, own: of :func:`rungs`, for the twin and for SUMO with late vehicles.
        gains: of :func:`gains`.
    """

    few: pd.DataFrame
    exact: pd.DataFrame
    conduct: pd.DataFrame
    rungs: pd.DataFrame
    own: pd.DataFrame
    gains: pd.DataFrame


def tables(found: Ladder) -> list[Table]:
    """Return what was found as tables to read, from the lowest rung to the highest, those that hold anything."""
    few_ = _table("1. One and two vehicles alone, to 1e-6", "vehicles", "commanded", "episodes", "the same")
    for row in found.few.itertuples():
        few_.add_row(f"{row.vehicles}", "yes" if row.commanded else "no", f"{row.episodes}", f"{row.same}")
    columns = ("policy", "demand", "approaches", "n", "same", "parted at", "KS speed", "accel.")
    steps = _table("2. Every vehicle and step; distance of speeds and accelerations", *columns)
    for row in found.exact.itertuples():
        parted = "" if np.isnan(row.median_parted) else f"step {row.median_parted:.0f}"
        distances = f"{row.ks_speed:.3f}", f"{row.ks_accel:.3f}"
        steps.add_row(row.policy, row.demand, row.kind, f"{row.episodes}", f"{row.same}", parted, *distances)
    done = _table("3. What drivers did, summed over episodes", "policy", "demand", "measure", "SUMO", "twin")
    for row in found.conduct.itertuples():
        if row.measure in MEASURE_TITLES:
            values = ("" if np.isnan(value) else f"{value:,.{_digits(value)}f}" for value in (row.sumo, row.twin))
            done.add_row(row.policy, row.demand, MEASURE_TITLES[row.measure], *values)
    shown = [few_, steps, done, *_aggregates(found.rungs, found.own), _benefits(found.gains)]
    return [table for table in shown if table.row_count]


MEASURE_TITLES = {
    "changes_needed": "lane changes, needed",
    "changes_left": "to the left",
    "changes_right": "to the right",
    "passed": "vehicles that passed",
    "permissive_lefts": "on a permissive left",
    "passed_on_red": "on red",
    "saturation_flow_vph": "saturation flow, veh/h",
    "start_up_lag_s": "start-up lag, s",
}
"""Measures of :func:`conduct` that are printed."""


def _digits(value: float) -> int:
    return 0 if value == int(value) or value > 100.0 else 2


def _aggregates(summed: pd.DataFrame, own: pd.DataFrame) -> list[Table]:
    found = []
    compared = {"twin against SUMO": summed}
    if not own.empty:
        compared["SUMO with a late vehicle against SUMO"] = own
    for title, rungs_ in compared.items():
        found.append(
            _table(f"4. CO2 per vehicle, {title}", *_ABOUT, "n", "mean|d|", "median", "bias", "worst", "> 5 %")
        )
        for row in rungs_.itertuples():
            found[-1].add_row(
                *(*_about(row), f"{row.approaches}", f"{row.co2_mean_abs:.1%}", f"{row.co2_median_abs:.1%}"),
                *(f"{row.co2_bias:+.1%}", f"{row.co2_worst:.0%}", _wide(row)),
            )
    for title, rungs_ in compared.items():
        found.append(_table(f"4. Vehicles, {title}", *_ABOUT, "crossed", "mean|d|", "travel", "stopped"))
        for row in rungs_.itertuples():
            found[-1].add_row(
                *(*_about(row), f"{row.crossed:+.1%}", f"{row.crossed_mean_abs:.1%}"),
                *("" if np.isnan(value) else f"{value:+.1%}" for value in (row.travel_time, row.stopped)),
            )
    return found


def _benefits(gained: pd.DataFrame) -> Table:
    benefit = _table("5. Benefit over human driving, not gated", *_ABOUT[:3], "SUMO", "twin", "points", "SUMO's own")
    for row in gained.itertuples():
        shown = ((row.sumo, "+.2%"), (row.twin, "+.2%"), (100 * row.difference, "+.2f"), (100 * row.own, ".2f"))
        benefit.add_row(*_about(row)[:3], *("" if np.isnan(value) else f"{value:{form}}" for value, form in shown))
    return benefit


_ABOUT = ("policy", "CVs", "demand", "lanes")
"""First columns of the tables."""


def _about(row: Any) -> tuple[str, ...]:
    lanes = {"one": "1", "several": "2+"}.get(getattr(row, "lanes", ""), "")
    return row.policy, f"{row.adoption:.0%}", row.demand, lanes


def _wide(row: Any) -> str:
    """How many approaches differ by more than 5 %, and how many beyond SUMO's own spread where that are fewer."""
    return f"{row.co2_wide}" if row.co2_wide == row.co2_beyond else f"{row.co2_wide} ({row.co2_beyond})"


def _table(title: str, *columns: str) -> Table:
    shown = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for column in columns:
        words = column in ("policy", "demand", "approaches", "lanes", "measure")
        shown.add_column(column, justify="left" if words else "right", no_wrap=column != "policy", overflow="fold")
    return shown


def plot(table: pd.DataFrame, path: Path, title: str) -> None:
    """Draw the CO2 of every approach on the twin against that in SUMO, a panel per policy."""
    policies: Sequence[str] = list(table["policy"].unique())
    figure = Figure(figsize=(3.6 * len(policies), 4.2), layout="constrained")
    for axes, policy in zip(figure.subplots(1, len(policies), squeeze=False)[0], policies, strict=True):
        group = table[table["policy"] == policy]
        largest = 1.05 * float(np.nanmax(group[["co2_g_sumo", "co2_g_twin"]].to_numpy(float), initial=1.0))
        axes.fill_between([0, largest], [0, 0.95 * largest], [0, 1.05 * largest], color="#e2e8f0", label="within 5 %")
        for one_lane, colour, label in ((True, "#2b6cb0", "one lane"), (False, "#c05621", "several lanes")):
            chosen = group[(group["lane_count"] == 1) == one_lane]
            axes.scatter(chosen["co2_g_sumo"], chosen["co2_g_twin"], s=12, color=colour, alpha=0.7, label=label)
        axes.set(xlim=(0, largest), ylim=(0, largest), title=policy, xlabel="SUMO: CO2 per vehicle (g)")
        axes.set_aspect("equal")
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("twin: CO2 per vehicle (g)")
    figure.suptitle(title, fontsize=11)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=150, format="png")
