"""Whether trajectories can be right: every refusal names the row, the column and what to do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from izoo.errors import IzooError

FASTEST_MPS = 45.0
"""162 km/h: above, a speed in town is km/h or mph, not m/s."""
LONGEST_GAP_M = 1000.0
SHORTEST_VEHICLE_M, LONGEST_VEHICLE_M = 0.5, 40.0
NUMBERS = ("time_s", "gap_m", "position_m", "speed_mps", "leader_speed_mps", "length_m")
TIME_TOLERANCE = 0.02
"""Of a step: by how much rows may be off."""
TIME_ROUNDING_S = 0.001 + 1e-9
"""By how much they may be off in any case: between two times that are given to a millisecond."""
SLOPE_RANGE = (0.67, 1.5)
"""Of changes of the gap over what the speeds say; metres over feet is 0.3, and m/s over km/h 3.6."""
WINDOW_S = 1.5
"""Gaps and speeds are compared over this time."""
CLEAR_CLOSING_MPS, CLEAR_SPEED_MPS, ENOUGH_S = 0.5, 3.0, 15.0
"""Where leader and follower differ by more, or a vehicle is faster, changes tell units; so much of that is needed."""
LONGEST_STEP_S = 1.0


class Problem:
    """Raises the error for the first row that cannot be used.

    Args:
        path: the file, for the message.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def refuse(self, table: pd.DataFrame, bad: pd.Series, column: str, remedy: str, shown: str | None = None) -> None:
        """Raise :class:`IzooError` if ``bad`` ``[rows]`` holds anywhere; ``shown``: the column whose value is told."""
        if not bad.any():
            return
        first = table.loc[bad].iloc[0]
        value = first[shown or column]
        text = f"{value:g}" if isinstance(value, (float, np.floating)) else repr(value)
        name = column if shown is None else f"{column} ({shown})"
        more = f" ({int(bad.sum())} rows in all)" if bad.sum() > 1 else ""
        raise IzooError(f"{self.path}, {first['row']}, column {name}: {text}; {remedy}{more}.")


def check_numbers(table: pd.DataFrame, problem: Problem) -> None:
    """Raise :class:`IzooError` for what is no number, missing, or outside what traffic in a town can show.

    Columns that should be numbers become float64.
    """
    if table.empty:
        raise IzooError(f"{problem.path} has a header but no rows; give trajectories.")
    for name in ("driver", "vehicle"):
        if name in table:
            problem.refuse(table, table[name].isna(), name, "every row needs the name of its driver")
    for name in NUMBERS:
        if name not in table:
            continue
        numbers = pd.to_numeric(table[name], errors="coerce")
        no_number = numbers.isna() & table[name].notna() & (table[name].astype(str).str.lower() != "nan")
        problem.refuse(table, no_number, name, "write a number with a decimal point")
        leader = name in ("gap_m", "leader_speed_mps")
        empty = "a row without a leader is to be left out" if leader else "fill it in or leave the row out"
        problem.refuse(table, ~np.isfinite(numbers), name, f"no finite number; {empty}")
        table[name] = numbers.astype(np.float64)
    for name in ("speed_mps", "leader_speed_mps"):
        if name in table:
            problem.refuse(table, table[name] < 0.0, name, "speeds are 0 or more; clip noise around 0")
            remedy = f"faster than {FASTEST_MPS:g} m/s is not driven in town; divide km/h by 3.6, mph by 2.237"
            problem.refuse(table, table[name] > FASTEST_MPS, name, remedy)
    if "gap_m" in table:
        remedy = "a gap is above 0: from the front bumper to the leader's rear bumper, not between centres"
        problem.refuse(table, table["gap_m"] <= 0.0, "gap_m", remedy)
        problem.refuse(table, table["gap_m"] > LONGEST_GAP_M, "gap_m", "nobody follows at that distance; leave it out")
    if "length_m" in table:
        legal = table["length_m"].between(SHORTEST_VEHICLE_M, LONGEST_VEHICLE_M)
        problem.refuse(table, ~legal, "length_m", f"lengths are {SHORTEST_VEHICLE_M:g} to {LONGEST_VEHICLE_M:g} m")


def time_step(pairs: pd.DataFrame, problem: Problem) -> float:
    """Return the step of the table, which is sorted by driver and time.

    Rows of a driver may be missing: times then differ by two or more steps. Anything else is refused.
    """
    change = pairs.groupby("driver", sort=False)["time_s"].diff()
    problem.refuse(
        pairs, change == 0.0, "time_s", "the driver has two rows at this time; keep one, or tell two drivers apart"
    )
    if change.notna().sum() == 0:
        raise IzooError(
            f"{problem.path}: every driver has one row; a calibration needs steps, from one row to the next."
        )
    # The smallest ones are the step; a percentile is not misled by a single odd row.
    step = float(np.percentile(change.dropna(), 10))
    single = change[change < 1.5 * step]
    # Their mean is (last - first) / count of every stretch without a gap, so that what times are rounded by cancels.
    step = float(single[(single - single.median()).abs() <= TIME_ROUNDING_S].mean())
    multiple = (change / step).round()
    allowed_s = max(TIME_TOLERANCE * step, TIME_ROUNDING_S)
    odd = change.notna() & ((multiple < 1) | ((change - multiple * step).abs() > allowed_s))
    remedy = f"the step is {step:g} s, and this row comes at another time; resample to equal steps"
    problem.refuse(pairs, odd, "time_s", remedy)
    if step > LONGEST_STEP_S:
        raise IzooError(
            f"{problem.path}, column time_s: a step of {step:g} s is too coarse for car following; give steps of "
            f"{LONGEST_STEP_S:g} s or less, in seconds."
        )
    return step


def check_units(pairs: pd.DataFrame, consecutive: pd.Series, step_s: float, path: Path) -> str | None:
    """Raise :class:`IzooError` where gaps change at another rate than the two speeds say: a wrong unit somewhere.

    Compared over windows of 1.5 s, whatever the step: within a step of a tenth of a second gaps change by less than
    they are recorded to.

    Args:
        pairs: sorted by driver and time.
        consecutive: ``[rows]`` bool: the next row is the same driver's next step.
        step_s: length of a step.
        path: for the message.

    Returns:
        What the user should know where gaps change too little to tell: that nothing was checked.
    """
    steps = max(1, round(WINDOW_S / step_s))
    closing_mps = pairs["leader_speed_mps"] - pairs["speed_mps"]
    gone = (closing_mps + closing_mps.shift(-1)) / 2.0 * step_s
    expected = sum((gone.shift(-k) for k in range(1, steps)), gone)
    whole = sum((consecutive.shift(-k, fill_value=False).astype(int) for k in range(1, steps)), consecutive.astype(int))
    clear = (whole == steps) & (expected.abs() > CLEAR_CLOSING_MPS * steps * step_s)
    clear_s = float(clear.sum()) * step_s
    if clear_s < ENOUGH_S:
        return (
            f"the units of {path} were not checked: leaders and followers differ by more than {CLEAR_CLOSING_MPS:g} "
            f"m/s over {clear_s:.0f} s only, and {ENOUGH_S:g} s are needed. Make sure of m and m/s, and of whose speed "
            "is whose"
        )
    slope = float(np.median((pairs["gap_m"].shift(-steps) - pairs["gap_m"])[clear] / expected[clear]))
    if not SLOPE_RANGE[0] <= slope <= SLOPE_RANGE[1]:
        raise IzooError(
            f"{path}, columns gap_m, speed_mps and leader_speed_mps: gaps change {slope:.2g} times as fast as the "
            "speeds say; one of them is not in m or m/s (feet times 0.3048, km/h divided by 3.6), or the leader's and "
            "the follower's speed are exchanged."
        )
    return None


def check_positions(table: pd.DataFrame, path: Path) -> None:
    """Raise :class:`IzooError` where vehicles advance at another rate than their own speeds say.

    Args:
        table: trajectories of all vehicles, in any order.
        path: for the message.
    """
    rows = table.sort_values(["vehicle", "time_s"], kind="stable")
    after = rows[["vehicle", "lane", "time_s", "position_m", "speed_mps"]].shift(-1)
    elapsed_s = after["time_s"] - rows["time_s"]
    speed_mps = (rows["speed_mps"] + after["speed_mps"]) / 2.0
    same = (rows["vehicle"] == after["vehicle"]) & (rows["lane"] == after["lane"])
    clear = same & (elapsed_s > 0.0) & (elapsed_s <= LONGEST_STEP_S) & (speed_mps > CLEAR_SPEED_MPS)
    if float(elapsed_s[clear].sum()) < ENOUGH_S:
        return
    slope = float(np.median(((after["position_m"] - rows["position_m"]) / (speed_mps * elapsed_s))[clear]))
    if not SLOPE_RANGE[0] <= slope <= SLOPE_RANGE[1]:
        raise IzooError(
            f"{path}, columns position_m and speed_mps: vehicles advance {slope:.2g} times as fast as their speeds "
            "say; one of them is not in m or m/s (feet times 0.3048, km/h divided by 3.6), or positions count against "
            "the direction of travel."
        )
