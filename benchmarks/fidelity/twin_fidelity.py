"""How far the twin is from SUMO: vehicle by vehicle, per approach and policy, and in what policies save."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from izoo.benchmarks.fidelity.driving_statistics import COUNTS, rates
from izoo.benchmarks.fidelity.trajectory_diff import COUNTED
from izoo.envs import SIMULATORS
from izoo.envs.mdp.metric_sums import APPROACH_METRICS
from izoo.metrics.figures import FIGURES
from izoo.metrics.pairing import HUMAN
from izoo.metrics.summary import summarise
from izoo.report.tables import Table
from izoo.results.rows_file import Row
from izoo.training.plots import PALETTE, QUIET, Chart, Series, draw, save

RELATIVE, ABSOLUTE = ("co2_g", "throughput"), ("delay_s",)
"""Figures that are compared per approach: by their relative difference, or by their difference."""
KEY = ["policy", "adoption", "demand", "lane_count", "context", "context_hash", "approach"]
GROUP = ["policy", "adoption", "demand", "lanes"]
"""What approaches are summed up by."""
WIDE = 0.05
"""Differences of CO2 above this, beyond SUMO's own spread, are counted."""


def approaches(sumo: pd.DataFrame, other: pd.DataFrame) -> pd.DataFrame:
    """Compare two plays of the same episodes, a row per policy and approach; sums are added over episode seeds.

    Human driving is compared once for each intersection and demand, as no CVs, whatever the context's share of them.

    Args:
        sumo, other: rows of the table (:mod:`izoo.results.schema`).

    Returns:
        :data:`KEY`, and per figure of :data:`RELATIVE` and :data:`ABSOLUTE` ``*_sumo``, ``*_other`` and
        ``*_difference`` (NaN where there is nothing to compare).
    """
    found = _levels(sumo).join(_levels(other), how="inner", lsuffix="_sumo", rsuffix="_other")
    for name in (*RELATIVE, *ABSOLUTE):
        apart, theirs = found[f"{name}_other"] - found[f"{name}_sumo"], found[f"{name}_sumo"]
        found[f"{name}_difference"] = apart if name in ABSOLUTE else apart / theirs.where(theirs > 0.0)
    table = found.reset_index()
    human = table["policy"] == HUMAN
    table.loc[human, "adoption"] = 0.0
    # Contexts that differ in the share of CVs alone have one name, and the same human driving.
    again = table.duplicated([name for name in KEY if name != "context_hash"])
    return table[~(human & again)].reset_index(drop=True)


def _levels(table: pd.DataFrame) -> pd.DataFrame:
    sums = table.groupby(KEY, sort=False)[list(APPROACH_METRICS)].sum()
    values = {name: FIGURES[name].value(sums, sums) for name in (*RELATIVE, *ABSOLUTE)}
    return pd.DataFrame(values, index=sums.index)


def own_spread(sumo: pd.DataFrame, late: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Compare SUMO with itself: :func:`approaches` for each evaluation with late vehicles, one below the other."""
    tables = [approaches(sumo, table).assign(late=number) for number, table in enumerate(late, 1)]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def with_spread(compared: pd.DataFrame, own: pd.DataFrame) -> pd.DataFrame:
    """Add ``co2_g_own`` to :func:`approaches`: the mean size of the relative differences of :func:`own_spread`."""
    if own.empty:
        return compared.assign(co2_g_own=np.nan)
    sizes = own["co2_g_difference"].abs().groupby([own[name] for name in KEY], sort=False).mean()
    return compared.join(sizes.rename("co2_g_own"), on=KEY)


def by_group(table: pd.DataFrame, by: Sequence[str] = GROUP) -> pd.DataFrame:
    """Sum :func:`approaches` up by policy, share of CVs, demand and kind of approach (one lane, several).

    ``co2_wide`` counts approaches whose CO2 differs by more than :data:`WIDE`, and ``co2_beyond`` those that do so
    beyond SUMO's own spread, where the table has it (:func:`with_spread`).
    """
    rows = []
    if "co2_g_own" not in table:
        table = table.assign(co2_g_own=np.nan)
    lanes = np.where(table["lane_count"] <= 1, "1", "2+")
    for key, group in table.assign(lanes=lanes).groupby(list(by), sort=False):
        co2, own, delay = group["co2_g_difference"], group["co2_g_own"], group["delay_s_difference"]
        crossed, theirs = group["throughput_other"].sum(), group["throughput_sumo"].sum()
        rows.append(
            dict(zip(by, key, strict=True))
            | {
                "approaches": int(co2.notna().sum()),
                "co2_mean_abs": float(co2.abs().mean()),
                "co2_bias": float(co2.mean()),
                "co2_median_abs": float(co2.abs().median()),
                "co2_wide": int((co2.abs() > WIDE).sum()),
                "co2_beyond": int((co2.abs() - own.fillna(0.0) > WIDE).sum()),
                "co2_own": float(own.mean()),
                "delay_s": float(delay.mean()),
                "crossed": crossed / theirs - 1.0 if theirs else np.nan,
            }
        )
    return pd.DataFrame(rows)


def gains(sumo: pd.DataFrame, twin: pd.DataFrame, late: Sequence[pd.DataFrame] = ()) -> pd.DataFrame:
    """Return the CO2 that policies save over human driving (%), a row per policy, share of CVs and demand.

    Args:
        sumo, twin: rows of the table.
        late: of SUMO with late vehicles.

    Returns:
        ``policy``, ``adoption``, ``demand``; what is saved in ``sumo`` and on the ``twin`` (NaN where there is no
        demand), their ``difference`` in points, and ``own``: the mean size of the difference that late vehicles make in
        SUMO (NaN without).
    """
    saved = [_saved(table) for table in (sumo, twin, *late)]
    rows = []
    for (policy, adoption, demand), here in saved[0].items():
        there, *others = (table[policy, adoption, demand] for table in saved[1:])
        own = float(np.mean([abs(value - here) for value in others])) if others else np.nan
        row = {"policy": policy, "adoption": adoption, "demand": demand, "sumo": here, "twin": there}
        rows.append({**row, "difference": there - here, "own": own})
    return pd.DataFrame(rows)


def _saved(table: pd.DataFrame) -> dict[tuple[str, float, str], float]:
    found = {}
    for (adoption, demand), part in table.groupby(["adoption", "demand"]):
        for policy, entry in summarise(part)["entries"].items():
            if HUMAN in entry["against"]:
                value = entry["against"][HUMAN]["all"]["figures"]["co2_saved"]["value"]
                found[policy, float(adoption), str(demand)] = np.nan if value is None else value
    return found


def same_order(gained: pd.DataFrame) -> bool:
    """Whether policies rank the same on both, at every share of CVs, with every demand."""
    gained = gained.dropna(subset=["sumo", "twin"]) if len(gained) else gained
    groups = gained.groupby(["adoption", "demand"]) if len(gained) else ()
    return all(bool((group["sumo"].rank() == group["twin"].rank()).all()) for _, group in groups)


def few(rows: Sequence[Row]) -> pd.DataFrame:
    """Sum up episodes of one and two vehicles, a row per number of vehicles, and commanded or not.

    Args:
        rows: of :func:`izoo.benchmarks.fidelity.single_vehicle.compare_few`.
    """
    if not rows:
        return pd.DataFrame()
    groups = pd.DataFrame(rows).groupby(["vehicles", "commanded"], sort=True)
    return groups["parted"].agg(episodes="size", same=lambda parted: int(parted.isna().sum())).reset_index()


def driving(exact: pd.DataFrame) -> pd.DataFrame:
    """Sum up what drivers did, a row per policy, demand and measure, with its value in SUMO and on the twin.

    Measures are those of :func:`izoo.benchmarks.fidelity.driving_statistics.rates`, then
    :data:`izoo.benchmarks.fidelity.driving_statistics.COUNTS`.

    Args:
        exact: rows of :func:`izoo.benchmarks.fidelity.trajectory_diff.compare_steps`; those without counts are left
            out.
    """
    exact = exact.dropna(subset=list(COUNTED)) if len(exact) else exact
    rows = []
    for key, group in exact.groupby(["policy", "demand"], sort=False) if len(exact) else ():
        about = dict(zip(("policy", "demand"), key, strict=True))
        counts = {side: {name: float(group[f"{name}_{side}"].sum()) for name in COUNTS} for side in ("sumo", "twin")}
        found = {side: rates(of) | of for side, of in counts.items()}
        rows += [about | {"measure": name} | {side: found[side][name] for side in found} for name in found["sumo"]]
    return pd.DataFrame(rows)


def exactness(exact: pd.DataFrame) -> pd.DataFrame:
    """Sum up episodes that were compared step by step, a row per policy, demand and kind of approach.

    Args:
        exact: rows of :func:`izoo.benchmarks.fidelity.trajectory_diff.compare_steps`.
    """
    if exact.empty:
        return pd.DataFrame()
    kinds = np.where(exact["lanes"] == 1, "1", "2+")
    numbers = exact.astype({"parted": float, "ks_speed": float, "ks_accel": float}).assign(lanes=kinds)
    summed = numbers.groupby(["policy", "demand", "lanes"], sort=False).agg(
        episodes=("seed", "size"),
        parted=("parted", "count"),
        median_parted=("parted", "median"),
        ks_speed=("ks_speed", "mean"),
        ks_accel=("ks_accel", "mean"),
    )
    return summed.assign(same=summed["episodes"] - summed["parted"]).reset_index()


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
"""Measures of :func:`driving` that are printed."""
_ABOUT = "policy; CVs=adoption|.0%; demand; "
COLUMNS = {
    "few": "vehicles; commanded; episodes; same",
    "exact": "policy; demand; lanes; n=episodes; same; parted at=median_parted|.0f; KS speed=ks_speed|.3f; "
    "accel.=ks_accel|.3f",
    "driving": "policy; demand; measure; SUMO=sumo; twin",
    "co2": f"{_ABOUT}lanes; n=approaches; mean|d|=co2_mean_abs|.1%; median=co2_median_abs|.1%; bias=co2_bias|+.1%; "
    "> 5 %=co2_wide; beyond=co2_beyond",
    "delay": f"{_ABOUT}lanes; delay, s=delay_s|+.2f; crossed=crossed|+.1%",
    "gains": f"{_ABOUT}SUMO=sumo|+.2f; twin|+.2f; points=difference|+.2f; SUMO's own=own|.2f",
    "overall": "policy; n=approaches; CO2 mean|d|=co2_mean_abs|.1%; SUMO itself=co2_own|.1%; bias=co2_bias|+.1%; "
    "delay, s=delay_s|+.2f; SUMO, %=sumo|+.1f; twin, %=twin|+.1f",
}
"""Columns of printed tables: ``heading=column|format``; the heading is that of the column where none is given."""


def headline(compared: pd.DataFrame, gained: pd.DataFrame) -> Table:
    """Return a row per policy: how far CO2 and delay of its approaches are apart, and what it saves on either side."""
    saved = gained.groupby("policy")[["sumo", "twin"]].mean()
    title = "The twin against SUMO, per approach; CO2 saved over human driving on either"
    return _table(title, by_group(compared, ["policy"]).join(saved, on="policy"), "overall")


def verdict(compared: pd.DataFrame, gained: pd.DataFrame) -> str:
    """Say in one sentence how far the twin is from SUMO."""
    (row,) = by_group(compared.assign(every=0), ["every"]).itertuples()
    own = "" if np.isnan(row.co2_own) else f" (SUMO is {row.co2_own:.1%} from itself where one vehicle comes late)"
    order = "rank the same on both" if same_order(gained) else "do not rank the same on both"
    far = f"CO2 per vehicle on the twin is {row.co2_mean_abs:.1%} from SUMO's on average over approaches"
    return f"{far}{own}; policies {order}."


def tables(found: Mapping[str, pd.DataFrame]) -> list[Table]:
    """Return what was found (``few``, ``exact``, ``driving``, ``groups``, ``own``, ``gains``) as tables, from the
    closest look to the widest, those that hold anything.
    """
    done = found["driving"]
    if len(done):
        done = done[done["measure"].isin(MEASURE_TITLES)]
        sides = {side: done[side].map(lambda x: _written(x, ",.0f" if x > 100.0 else ",.4g")) for side in SIMULATORS}
        done = done.assign(measure=done["measure"].map(MEASURE_TITLES), **sides)
    late = "SUMO with a late vehicle against SUMO"
    shown = [
        _table("1. One and two vehicles alone, to 1e-6", found["few"], "few"),
        _table("2. Every vehicle and step; distance of speeds and accelerations", found["exact"], "exact"),
        _table("3. What drivers did, summed over episodes", done, "driving"),
        _table("4. CO2 per vehicle, twin against SUMO", found["groups"], "co2"),
        _table("4. Delay and vehicles, twin against SUMO", found["groups"], "delay"),
        _table(f"4. CO2 per vehicle, {late}", found["own"], "co2"),
        _table("5. CO2 saved over human driving, %", found["gains"], "gains"),
    ]
    return [table for table in shown if table.rows]


def _table(title: str, frame: pd.DataFrame, kind: str) -> Table:
    columns = []
    for part in COLUMNS[kind].split("; "):
        heading, _, column = part.rpartition("=")
        column, _, form = column.partition("|")
        columns.append((heading or column, column, form))
    rows = [[_written(row[column], form) for _, column, form in columns] for row in frame.to_dict("records")]
    return Table.of(title, (heading for heading, _, _ in columns), rows)


def _written(value: Any, form: str) -> str:
    return "" if value is None or value != value else f"{value:{form}}"


def plot(table: pd.DataFrame, path: Path, title: str) -> None:
    """Draw the CO2 of every approach on the twin against that in SUMO, a panel per policy."""
    charts = []
    for policy, group in table.groupby("policy", sort=False):
        ends = np.array([0.0, np.nanmax(group[["co2_g_sumo", "co2_g_other"]].to_numpy(float), initial=1.0)])
        marks = [Series(ends, ends, "", "band", 0.95 * ends, 1.05 * ends, QUIET)]
        for several, (colour, name) in enumerate(zip(PALETTE, ("one lane", "several lanes"), strict=False)):
            of = group[(group["lane_count"] > 1) == bool(several)]
            marks.append(Series(of["co2_g_sumo"], of["co2_g_other"], name, "points", colour=colour))
        charts.append(Chart("", str(policy), marks, "SUMO: CO2 per vehicle (g), 5 % shaded", "twin"))
    save(draw(charts, title), path)
