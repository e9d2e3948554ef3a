"""Trajectory files: every form gives the same pairs, and what cannot be right is refused by row, column and remedy."""

import gzip
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from izoo.drivers.recorded_pairs import read_pairs
from izoo.drivers.trajectories import Following, ReadConfig, read_following
from izoo.errors import IzooError
from tests.drivers.platoons import platoon_table


def written(table: pd.DataFrame, folder: Path, name: str = "pairs.csv") -> Path:
    path = folder / name
    table.to_csv(path, index=False)
    return path


def read(table: pd.DataFrame, folder: Path, **options: Any) -> tuple[dict[str, Following], list[str]]:
    return read_following([written(table, folder)], ReadConfig(**options))


@pytest.fixture(scope="module")
def pairs() -> pd.DataFrame:
    return platoon_table(8, 60)


def convoy(vehicles: int = 12, steps: int = 50) -> pd.DataFrame:
    """All vehicles of a lane in single file, the last ones heavy."""
    generator = np.random.default_rng(1)
    rows = []
    for number in range(vehicles):
        length = 12.0 if number >= 6 else 4.0
        for k in range(steps):
            time_s = 0.5 * k
            speed = 8.0 + np.sin(0.6 * time_s - number)
            swing = (np.cos(number) - np.cos(0.6 * time_s - number)) / 0.6
            position = 900.0 - 30.0 * number + 8.0 * time_s + swing + generator.uniform(0.0, 0.01)
            rows.append((f"v{number}", time_s, "A_0", position, speed, length))
    return pd.DataFrame(rows, columns=["vehicle", "time_s", "lane", "position_m", "speed_mps", "length_m"])


def test_pairs_become_steps_of_drivers(pairs: pd.DataFrame, tmp_path: Path) -> None:
    shuffled = pairs.sample(frac=1.0, random_state=0)
    classes, notes = read(shuffled, tmp_path)
    data = classes["light"]
    assert set(classes) == {"light"} and notes == []
    assert (len(data.drivers), data.step_s) == (8, 0.5)
    own = pairs[pairs["driver"] == data.drivers[3]].reset_index(drop=True)
    stands = (own["speed_mps"] < 0.5) & (own["leader_speed_mps"] < 0.5)
    kept = own.index[:-1][~stands[:-1]]
    count = int(data.used[3].sum())
    assert count == len(kept) > 40
    np.testing.assert_allclose(data.gap_m[3, :count], own["gap_m"][kept])
    np.testing.assert_allclose(data.next_speed_mps[3, :count], own["speed_mps"][kept + 1])
    assert data.continues[3, 1:count].mean() > 0.8 and not data.continues[:, 0].any()


def test_finer_steps_are_thinned_and_missing_rows_split(pairs: pd.DataFrame, tmp_path: Path) -> None:
    fine = pairs.assign(time_s=pairs["time_s"] / 5.0)  # a step of 0.1 s
    fine["gap_m"] = 20.0 + 0.0 * fine["gap_m"]
    fine["leader_speed_mps"] = fine["speed_mps"]
    classes, _ = read(fine.drop(index=[70]), tmp_path, step_s=0.2)
    data = classes["light"]
    assert data.step_s == 0.2
    row = data.drivers.index("car1")
    # Every second row of 60 is 30 rows and 29 steps; row 70 is one of them, so two steps are gone.
    moving = {driver: int(data.used[k].sum()) for k, driver in enumerate(data.drivers)}
    assert moving["car1"] <= 27 < max(moving.values()) <= 29
    assert (~data.continues[row, : moving["car1"]]).sum() >= 2
    with pytest.raises(IzooError, match=r"--step-s is 0.25, but the step of .* is 0.1 s"):
        read(fine, tmp_path, step_s=0.25)


@pytest.mark.parametrize("rate_per_s", [30.0, 24.0, 60.0])
def test_times_may_be_rounded_to_milliseconds(rate_per_s: float, tmp_path: Path) -> None:
    """As those of a video are."""
    time_s = np.arange(round(20 * rate_per_s)) / rate_per_s
    tables = []
    for driver in range(6):
        speed, leader = 10.0 + np.sin(time_s + driver), 10.0 + np.sin(time_s + driver + 0.5)
        gap = 20.0 + np.cumsum(leader - speed) / rate_per_s
        about = {"driver": f"d{driver}", "time_s": time_s.round(3), "length_m": 5.0}
        tables.append(pd.DataFrame(about | {"gap_m": gap, "speed_mps": speed, "leader_speed_mps": leader}))
    table = pd.concat(tables, ignore_index=True)
    data = read(table, tmp_path)[0]["light"]
    assert data.step_s == 0.5 and (data.used.sum(axis=1) == 39).all()
    table.loc[300, "time_s"] += 0.008
    with pytest.raises(IzooError, match=r"column time_s: .*; the step is 0.0\d+ s, and this row comes at another time"):
        read(table, tmp_path)


def finer(table: pd.DataFrame, rate_per_s: float) -> pd.DataFrame:
    """Pairs at a finer step, whose speeds run straight from one row to the next."""
    rows = []
    for driver, own in table.groupby("driver"):
        time_s = np.arange(0.0, own["time_s"].max(), 1.0 / rate_per_s)
        speed, leader = (np.interp(time_s, own["time_s"], own[name]) for name in ("speed_mps", "leader_speed_mps"))
        gone = np.cumsum((leader - speed)[:-1] + (leader - speed)[1:]) / 2.0 / rate_per_s
        gap = 20.0 + np.concatenate([[0.0], gone])
        columns = {"gap_m": gap - min(gap.min() - 1.0, 0.0), "speed_mps": speed, "leader_speed_mps": leader}
        rows.append(pd.DataFrame({"driver": driver, "length_m": 5.0, "time_s": time_s.round(3), **columns}))
    return pd.concat(rows, ignore_index=True)


SWAPPED = {"speed_mps": "leader_speed_mps", "leader_speed_mps": "speed_mps"}


@pytest.mark.parametrize("rate_per_s", [1.0, 2.0, 10.0, 25.0, 30.0])
def test_units_are_checked_at_every_step(pairs: pd.DataFrame, rate_per_s: float, tmp_path: Path) -> None:
    """Within a tenth of a second gaps change by little, over a second and a half by as much as the speeds say."""
    right = finer(pairs, rate_per_s)
    _, notes = read(right, tmp_path)
    assert not [note for note in notes if "unit" in note]
    for change, message in (
        (right.assign(gap_m=right["gap_m"] / 0.3048), "gaps change 3.3 times as fast.*feet"),
        (right.assign(**{name: right[name] * 2.237 for name in SWAPPED}), "gaps change 0.45 times as fast"),
        (right.rename(columns=SWAPPED), "gaps change -1 times as fast.*exchanged"),
    ):
        with pytest.raises(IzooError, match=message):
            read(change, tmp_path)


def test_it_is_said_where_units_cannot_be_checked(pairs: pd.DataFrame, tmp_path: Path) -> None:
    steady = pairs.assign(speed_mps=12.0, leader_speed_mps=12.1)
    _, notes = read(steady, tmp_path)
    said = "were not checked: leaders and followers differ by more than 0.5 m/s over 0 s"
    assert "units of" in notes[0] and said in notes[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position_m": 1 / 0.3048, "length_m": 1 / 0.3048}, "vehicles advance 3.3 times as fast as their speeds say"),
        ({"speed_mps": 3.6}, "vehicles advance 0.28 times as fast .*km/h divided by 3.6"),
        ({"position_m": -1.0}, "vehicles advance -1 times as fast .*against the direction of travel"),
    ],
)
def test_positions_and_speeds_in_different_units(change: dict[str, float], message: str, tmp_path: Path) -> None:
    """Also of vehicles whose gaps hardly change."""
    table = convoy()
    table = table.assign(**{name: table[name] * factor for name, factor in change.items()})
    with pytest.raises(IzooError, match=message):
        read(table, tmp_path)


def test_trajectories_of_all_vehicles_become_pairs(tmp_path: Path) -> None:
    table = convoy()
    classes, _ = read(table, tmp_path)
    assert set(classes) == {"light", "heavy"}
    assert classes["light"].drivers == ("v1", "v2", "v3", "v4", "v5")  # v0 has no leader
    assert classes["heavy"].drivers == ("v10", "v11", "v6", "v7", "v8", "v9")
    row = classes["heavy"].drivers.index("v7")
    gaps = classes["heavy"].gap_m[row][classes["heavy"].used[row]]
    np.testing.assert_allclose(gaps, 18.0, atol=3.5)  # 30 m minus the leader's 12 m, and their swings


def test_a_red_light_is_not_a_leader(tmp_path: Path) -> None:
    table = convoy()
    table["signal"] = np.where(table["time_s"] >= 18.0, "red", "green")
    rows = read_pairs(written(table, tmp_path), None, 6.5)
    assert rows["time_s"].max() == 17.5
    standing = table.assign(speed_mps=0.0)
    assert read_pairs(written(standing, tmp_path), None, 6.5)["time_s"].max() == 24.5
    table["signal"] = "purple"
    with pytest.raises(IzooError, match=r"row \d+, column signal: 'purple'; write green, yellow or red"):
        read_pairs(written(table, tmp_path), None, 6.5)


@pytest.mark.parametrize("form", ["xml", "xml.gz", "semicolons", "plain", "persons", "gzip", "izoo"])
def test_every_form_gives_the_same_pairs(form: str, tmp_path: Path) -> None:
    table = convoy()
    expected = read_pairs(written(table, tmp_path), None, 6.5)
    path = tmp_path / "other.csv"
    if form.startswith("xml"):
        path = tmp_path / f"fcd.{form}"
        steps = []
        for time, rows in table.groupby("time_s"):
            vehicles = "".join(
                f'<vehicle id="{r.vehicle}" x="1" y="2" lane="{r.lane}" pos="{r.position_m!r}" speed="{r.speed_mps!r}"'
                f' length="{r.length_m}"/>'
                for r in rows.itertuples()
            )
            steps.append(f'<timestep time="{time}">{vehicles}</timestep>')
        person = "<person id='p' x='1' y='2' speed='1' pos='3' edge='A'/>"
        text = f"<fcd-export>{''.join(steps)}<timestep time='99'>{person}</timestep></fcd-export>".encode()
        path.write_bytes(gzip.compress(text) if form == "xml.gz" else text)
    elif form == "semicolons":
        names = {"vehicle": "vehicle_id", "position_m": "vehicle_pos", "lane": "vehicle_lane"}
        names |= {"time_s": "timestep_time", "speed_mps": "vehicle_speed", "length_m": "vehicle_length"}
        other = table.rename(columns=names)
        other.to_csv(path, index=False, sep=";")
        with path.open("a") as file:
            file.write(";25.0;;;;\n")  # a step in which nobody is there
    elif form in ("plain", "persons"):  # as SUMO itself writes CSV; a person may come first and name the columns
        prefix = "" if form == "plain" else "person_"
        names = {"vehicle": "id", "lane": "lane", "position_m": "pos", "speed_mps": "speed", "length_m": "length"}
        other = table.assign(type="car").rename(columns={"time_s": "time", **names})
        walking = {"time": 0.0, "id": "p", "lane": None, "pos": 1.0, "speed": 1.0, "length": 0.2, "type": "x"}
        riding = {"time": 0.0, "id": "q", "lane": "A_0", "pos": 900.0, "speed": 1.0, "type": "DEFAULT_PEDTYPE"}
        other = pd.concat([pd.DataFrame([walking, riding]), other]).add_prefix(prefix)
        time = "time" if form == "plain" else "timestep_time"
        other.rename(columns={f"{prefix}time": time}).to_csv(path, index=False, sep=";")
    elif form == "gzip":
        path = tmp_path / "pairs.csv.gz"
        path.write_bytes(gzip.compress((tmp_path / "pairs.csv").read_bytes()))
    else:
        other = table.rename(columns={"vehicle": "vehicle_number", "position_m": "lane_position_m"})
        other["region_lane"], other["lane"] = 7, 0
        other["location"], other["stop_line_distance_m"] = 2, 10.0
        other.to_csv(path, index=False)
    got = read_pairs(path, None, 6.5)
    by = {"by": ["driver", "time_s"], "ignore_index": True}
    pd.testing.assert_frame_equal(*(rows.drop(columns="row").sort_values(**by) for rows in (got, expected)))


def test_the_approach_to_a_signal_in_izoos_own_tables_is_left_out(tmp_path: Path) -> None:
    table = convoy().rename(columns={"vehicle": "vehicle_number", "position_m": "lane_position_m"})
    table["region_lane"], table["stop_line_distance_m"] = 7, -10.0
    table["location"] = np.where(table["time_s"] < 10.0, 0, 2)
    assert read_pairs(written(table.drop(columns="lane"), tmp_path), None, 6.5)["time_s"].min() == 10.0


def test_drivers_of_two_files_are_different_ones(pairs: pd.DataFrame, tmp_path: Path) -> None:
    few = pairs[pairs["driver"].isin(["car0", "car1", "car2"])]
    files = [written(few, tmp_path, "a.csv"), written(few, tmp_path, "b.csv")]
    assert len(read_following(files, ReadConfig())[0]["light"].drivers) == 6
    other = written(few.assign(time_s=few["time_s"] * 0.8), tmp_path, "c.csv")
    with pytest.raises(IzooError, match=r"steps of the files differ: .*a.csv 0.5 s and .*c.csv 0.4 s"):
        read_following([files[0], other], ReadConfig())


def test_more_drivers_than_asked_for_are_drawn_from(pairs: pd.DataFrame, tmp_path: Path) -> None:
    classes, notes = read(pairs, tmp_path, max_drivers=5, seed=3)
    assert len(classes["light"].drivers) == 5
    assert "5 of 8 light drivers are used" in notes[0]


def at(row: int, column: str, value: Any) -> Any:
    def change(table: pd.DataFrame) -> pd.DataFrame:
        table[column] = table[column].astype(object)
        table.loc[row - 2, column] = value
        return table

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (at(17, "gap_m", -1.5), r"row 17, column gap_m: -1.5; a gap is above 0: from the front bumper"),
        (at(18, "gap_m", 0.0), r"row 18, column gap_m: 0; a gap is above 0"),
        (at(19, "gap_m", float("nan")), r"row 19, column gap_m: nan; .*a row without a leader is to be left out"),
        (at(20, "leader_speed_mps", float("inf")), r"row 20, column leader_speed_mps: inf; no finite number"),
        (at(21, "speed_mps", 60.0), r"row 21, column speed_mps: 60; .*divide km/h by 3.6, mph by 2.237"),
        (at(22, "speed_mps", "fast"), r"row 22, column speed_mps: 'fast'; write a number"),
        (at(23, "speed_mps", -0.2), r"row 23, column speed_mps: -0.2; speeds are 0 or more"),
        (at(24, "length_m", 400.0), r"row 24, column length_m: 400; lengths are 0.5 to 40 m"),
        (at(25, "length_m", 12.0), r"column driver: 'car0'; the driver is light in some rows and heavy in others"),
        (at(26, "time_s", 12.1), r"row 26, column time_s: 12.1; the step is 0.5 s.*resample to equal steps"),
        (at(27, "time_s", 12.0), r"column time_s: 12; the driver has two rows at this time"),
        (at(28, "gap_m", 2000.0), r"row 28, column gap_m: 2000; nobody follows at that distance"),
        (lambda t: t[t["driver"] == "car0"], r": 1 of 1 light drivers have 20 steps of 0.5 s behind"),
        (lambda t: t[t["time_s"] % 5.0 < 0.9], r"0 of \d+ light drivers have 20 steps of 0.5 s .*at equal steps"),
        (at(29, "driver", float("nan")), r"row 29, column driver: nan; every row needs the name of its driver"),
        (lambda t: t.drop(columns="gap_m"), r"no column gap_m; give pairs \(driver, time_s, gap_m"),
        (lambda t: t.drop(columns="time_s"), r"no column time_s"),
        (lambda t: t.drop(columns="length_m"), r"does not say how long vehicles are.*--default-length-m 5"),
        (lambda t: t.assign(vehicle_class="lorry"), r"row 2, column vehicle_class: 'lorry'; write light or heavy"),
        (lambda t: t.assign(time_s=t["time_s"] * 10.0), r"column time_s: a step of 5 s is too coarse"),
        (lambda t: t.assign(gap_m=t["gap_m"] / 0.3048), r"gaps change 3.2 times as fast as the speeds say.*feet"),
        (lambda t: t.rename(columns=SWAPPED), r"gaps change -0.99 times.*exchanged"),
        (lambda t: t.drop_duplicates("driver"), r"every driver has one row"),
        (lambda t: t.iloc[:0], r"has a header but no rows"),
    ],
)
def test_pairs_that_cannot_be_right(change: Any, message: str, pairs: pd.DataFrame, tmp_path: Path) -> None:
    path = written(change(pairs.copy()), tmp_path)
    with pytest.raises(IzooError, match=message) as caught:
        read_following([path], ReadConfig())
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.assign(lane=t["vehicle"]), r"nobody has a leader: no two vehicles are on one lane"),
        (lambda t: t.assign(length_m=35.0), r"column position_m \(gap_m\): -.*the vehicle overlaps its leader"),
        (at(30, "lane", float("nan")), r"row 30, column lane: nan; every row needs the lane"),
        (at(32, "vehicle", float("nan")), r"row 32, column vehicle: nan; every row needs the name"),
        (lambda t: t.drop(columns="lane"), r"no column lane; give pairs"),
        (at(31, "position_m", float("nan")), r"row 31, column position_m: nan; no finite number; fill it in"),
    ],
)
def test_trajectories_that_cannot_be_right(change: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(IzooError, match=message):
        read(change(convoy()), tmp_path)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", b"", "cannot read .*a.csv: "),
        ("b.csv", b"\xff\xfe\x00\x01" * 50, "cannot read .*b.csv|no column"),
        ("c.xml", b"<fcd-export><timestep", "cannot read .*c.xml"),
        ("d.xml", b'<!DOCTYPE x [<!ENTITY a "b">]><x>&a;</x>', "cannot read .*d.xml"),
        ("e.csv", None, "e.csv is no file"),
    ],
)
def test_files_that_are_no_tables(name: str, content: bytes | None, message: str, tmp_path: Path) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(IzooError, match=message):
        read_following([path], ReadConfig())
    with pytest.raises(IzooError, match="is a folder"):
        read_following([tmp_path], ReadConfig())


def test_no_pickle_is_ever_opened(tmp_path: Path) -> None:
    """A table that would run code when unpickled is refused as text."""

    class Trap:
        def __reduce__(self) -> Any:
            return (Path.touch, (tmp_path / "sprung",))

    for name in ("evil.csv", "evil.pkl"):
        path = tmp_path / name
        path.write_bytes(pickle.dumps(Trap()))
        with pytest.raises(IzooError):
            read_following([path], ReadConfig())
    assert not (tmp_path / "sprung").exists()
