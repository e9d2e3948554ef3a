"""Files with trajectories, read into one form: a table of followers and their leaders (``izoo/docs/calibration.md``).

Four kinds are told apart by their columns: leader-follower pairs; trajectories of all vehicles with lane and position;
what :func:`izoo.envs.views.trajectories.write_trajectories` writes; and SUMO's floating car data (XML or CSV).
"""

from __future__ import annotations

import gzip
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from defusedxml import ElementTree
from defusedxml.common import DefusedXmlException

from izoo.drivers.checks import Problem, check_numbers, check_positions
from izoo.errors import IzooError

PAIR_COLUMNS = ("driver", "time_s", "gap_m", "speed_mps", "leader_speed_mps")
TRAJECTORY_COLUMNS = ("vehicle", "time_s", "lane", "position_m", "speed_mps")
IZOO_NAMES = {"vehicle_number": "vehicle", "region_lane": "lane", "lane_position_m": "position_m"}
FCD_NAMES = {
    "time": "time_s",
    "id": "vehicle",
    "lane": "lane",
    "pos": "position_m",
    "speed": "speed_mps",
    "length": "length_m",
}
_FCD_PREFIX = re.compile(r"(timestep_)?((vehicle|person)_)?")
"""SUMO writes headers with the names of elements or without, those of its first row: which may be a person's."""
_WALKING = "DEFAULT_PEDTYPE"
CLASSES = ("light", "heavy")
GREEN = {"green", "g", "0", "0.0", "", "nan"}
"""What the column ``signal`` may hold where drivers need not obey it; nothing means that no signal is ahead."""
SIGNALS = GREEN | {"yellow", "y", "1", "1.0", "red", "r", "2", "2.0"}
STANDING_MPS = 0.1


def read_pairs(path: Path, default_length_m: float | None, heavy_from_m: float) -> pd.DataFrame:
    """Return the leader-follower pairs of a file.

    Args:
        path: CSV (comma or semicolon, also ``.csv.gz``) or SUMO's XML (also ``.xml.gz``).
        default_length_m: of vehicles whose file says no length; ``None``: such a file is refused.
        heavy_from_m: vehicles of this length or more are heavy.

    Returns:
        Columns ``driver`` (text), ``heavy`` (bool), :data:`PAIR_COLUMNS` as float64, and ``row``: where it stands.

    Raises:
        IzooError: the file cannot be read, or a value cannot be right: it names row, column and remedy.
    """
    table = _read(path)
    problem = Problem(path)
    if _holds_pairs(set(table)):
        _require(table, PAIR_COLUMNS, path)
        if not {"vehicle_class", "length_m"} & set(table):
            table["length_m"] = _lengths(default_length_m, path)
        check_numbers(table, problem)
        pairs = table
    else:
        _require(table, TRAJECTORY_COLUMNS, path)
        if "length_m" not in table:
            table["length_m"] = _lengths(default_length_m, path)
        check_numbers(table, problem)
        check_positions(table, path)
        pairs = _with_leaders(table, problem)
    pairs["heavy"] = _heavy(pairs, heavy_from_m, problem)
    pairs["driver"] = pairs["driver"].astype(str)
    return pairs[["driver", "heavy", *PAIR_COLUMNS[1:], "row"]].reset_index(drop=True)


def _holds_pairs(columns: set[str]) -> bool:
    """Whether a file is meant as pairs, also where one of their columns is missing."""
    some = bool({"driver", "gap_m", "leader_speed_mps"} & columns) and not {"lane", "position_m"} & columns
    return some or {"gap_m", "leader_speed_mps"} <= columns


def _read(path: Path) -> pd.DataFrame:
    """Return the raw table with izoo's column names, and ``row``: the line of a CSV, or vehicle and time in XML."""
    if path.is_dir() or not path.exists():
        what = "a folder" if path.is_dir() else "no file"
        raise IzooError(f"{path} is {what}; give a CSV of trajectories or SUMO's floating car data.")
    try:
        if path.name.endswith((".xml", ".xml.gz")):
            with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
                return _read_fcd(file)
        # SUMO's own converter of XML to CSV separates by semicolons.
        header = pd.read_csv(path, nrows=0, sep="\0", engine="python").columns[0]
        separator = ";" if header.count(";") > header.count(",") else ","
        table = pd.read_csv(path, sep=separator, skipinitialspace=True, low_memory=False)
    except (OSError, ValueError, EOFError, ElementTree.ParseError, DefusedXmlException, pd.errors.ParserError) as error:
        raise IzooError(f"cannot read {path}: {str(error).splitlines()[0]}; give CSV with a header line.") from None
    if set(IZOO_NAMES) <= set(table):
        # There, ``lane`` counts the lanes of an edge, and edges have the same ones.
        table = table.drop(columns="lane", errors="ignore").rename(columns=IZOO_NAMES)
    # A header is line 1.
    table["row"] = [f"row {number}" for number in range(2, len(table) + 2)]
    return _from_sumo(table) if separator == ";" else table


def _from_sumo(table: pd.DataFrame) -> pd.DataFrame:
    """Return floating car data under izoo's names, without persons and steps that have no vehicle."""
    if any(name.endswith("vehicle_id") for name in table):
        table = table.drop(columns=[name for name in table if "person_" in name])
    plain = {name: _FCD_PREFIX.sub("", name, count=1) for name in table}
    table = table.rename(columns={name: FCD_NAMES[kept] for name, kept in plain.items() if kept in FCD_NAMES})
    kinds = [name for name, kept in plain.items() if kept == "type"]
    if kinds and {"vehicle", "lane"} <= set(table):
        table = table[table["vehicle"].notna() & table["lane"].notna() & (table[kinds[0]] != _WALKING)]
    elif "vehicle" in table:
        table = table[table["vehicle"].notna()]
    return table


def _read_fcd(file: Any) -> pd.DataFrame:
    rows: dict[str, list[str]] = {name: [] for name in (*TRAJECTORY_COLUMNS, "length_m", "row")}
    time = ""
    for event, element in ElementTree.iterparse(file, events=("start", "end")):
        if event == "start" and element.tag == "timestep":
            time = element.get("time", "")
        elif event == "end" and element.tag == "vehicle":
            values = (element.get("id"), time, element.get("lane"), element.get("pos"), element.get("speed"))
            for name, value in zip(TRAJECTORY_COLUMNS, values, strict=True):
                rows[name].append("" if value is None else value)
            rows["length_m"].append(element.get("length", ""))
            rows["row"].append(f"vehicle {values[0]!r} at {time} s")
        elif event == "end" and element.tag == "timestep":
            element.clear()
    table = pd.DataFrame(rows)
    if not table["length_m"].any():
        table = table.drop(columns="length_m")
    for name in ("time_s", "position_m", "speed_mps", "length_m"):
        if name in table:
            table[name] = pd.to_numeric(table[name], errors="coerce")
    return table


def _require(table: pd.DataFrame, columns: tuple[str, ...], path: Path) -> None:
    missing = [name for name in columns if name not in table]
    if missing:
        raise IzooError(
            f"{path} has no column {', '.join(missing)}; give pairs ({', '.join(PAIR_COLUMNS)}, and vehicle_class or "
            f"length_m) or trajectories ({', '.join(TRAJECTORY_COLUMNS)}, length_m)."
        )


def _lengths(default_length_m: float | None, path: Path) -> float:
    if default_length_m is None:
        raise IzooError(
            f"{path} does not say how long vehicles are; add a column length_m, or give one length to all: "
            "--default-length-m 5."
        )
    return default_length_m


def _heavy(pairs: pd.DataFrame, heavy_from_m: float, problem: Problem) -> pd.Series:
    if "vehicle_class" not in pairs:
        return pairs["length_m"] >= heavy_from_m
    names = pairs["vehicle_class"].astype(str).str.strip().str.lower()
    problem.refuse(pairs, ~names.isin(CLASSES), "vehicle_class", f"write {' or '.join(CLASSES)}")
    return names == "heavy"


def _with_leaders(table: pd.DataFrame, problem: Problem) -> pd.DataFrame:
    """Return the rows of a trajectory table that have a leader on their lane, as pairs.

    A row whose driver has to obey a yellow or red signal rather than follow is left out: where ``signal`` says so; in
    izoo's own tables, which do not say it, on every approach. Behind a leader that stands, they follow all the same.
    """
    problem.refuse(table, table["lane"].isna(), "lane", "every row needs the lane that the vehicle is on")
    table = table.sort_values(["time_s", "lane", "position_m"], kind="stable")
    by_place = table.groupby(["time_s", "lane"], sort=False)
    for name in ("position_m", "length_m", "speed_mps"):
        table[f"leader_{name}"] = by_place[name].shift(-1)
    pairs = table[table["leader_speed_mps"].notna()].copy()
    if pairs.empty:
        raise IzooError(
            f"{problem.path}: nobody has a leader: no two vehicles are on one lane at the same time; check the columns "
            "lane and time_s."
        )
    pairs["gap_m"] = pairs["leader_position_m"] - pairs["leader_length_m"] - pairs["position_m"]
    problem.refuse(
        pairs,
        pairs["gap_m"] <= 0.0,
        "position_m",
        "the vehicle overlaps its leader; positions are of front bumpers along the lane, lengths in m",
        "gap_m",
    )
    pairs["driver"] = pairs["vehicle"]
    free = _free_of_signals(pairs, problem) | (pairs["leader_speed_mps"] < STANDING_MPS)
    return pairs[free]


def _free_of_signals(pairs: pd.DataFrame, problem: Problem) -> pd.Series:
    if "signal" in pairs:
        shown = pairs["signal"].astype(str).str.strip().str.lower()
        problem.refuse(pairs, ~shown.isin(SIGNALS), "signal", "write green, yellow or red, or nothing")
        return shown.isin(GREEN)
    if "location" in pairs and "stop_line_distance_m" in pairs:
        return pairs["location"] != 0
    return pd.Series(np.ones(len(pairs), bool), index=pairs.index)
