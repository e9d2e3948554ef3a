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
CLEAR_CHANGE_M, ENOUGH_ROWS = 0.25, 30
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


def check_units(pairs: pd.DataFrame, consecutive: pd.Series, step_s: float, path: Path) -> None:
    """Raise :class:`IzooError` where gaps change at another rate than the two speeds say: a wrong unit somewhere.

    Args:
        pairs: sorted by driver and time.
        consecutive: ``[rows]`` bool: the next row is the same driver's next step.
        step_s: length of a step.
        path: for the message.
    """
    after = pairs[["gap_m", "speed_mps", "leader_speed_mps"]].shift(-1)
    closing = (pairs["leader_speed_mps"] + after["leader_speed_mps"] - pairs["speed_mps"] - after["speed_mps"]) / 2.0
    expected = closing * step_s
    clear = consecutive & (expected.abs() > CLEAR_CHANGE_M)
    if clear.sum() < ENOUGH_ROWS:
        return
    slope = float(np.median((after["gap_m"] - pairs["gap_m"])[clear] / expected[clear]))
    if not SLOPE_RANGE[0] <= slope <= SLOPE_RANGE[1]:
        raise IzooError(
            f"{path}, columns gap_m, speed_mps and leader_speed_mps: gaps change {slope:.2g} times as fast as the "
            "speeds say; one of them is not in m or m/s (feet times 0.3048, km/h divided by 3.6), or the leader's and "
            "the follower's speed are exchanged."
        )
