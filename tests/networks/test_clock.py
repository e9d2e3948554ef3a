"""The signal clock: tables by hand, by brute force, and against SUMO's own signal."""

import functools
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from defusedxml import ElementTree

from izoo.contexts.procedural import procedural_context
from izoo.contexts.source import ContextList
from izoo.envs.mdp.signals import CLOCK, Shown, clock_tables, phase_of_step, read_clock
from izoo.envs.sumo.session import SumoSession, import_libsumo, sumo_arguments
from izoo.envs.tables import compiled, directory, opener
from izoo.errors import IzooError
from izoo.networks.clock import GREEN, NEVER_S, RED, YELLOW, SignalClock, make_clock
from izoo.networks.net.build import build_net
from izoo.networks.road import RoadNet, read_road


def plan(duration_s: np.ndarray, colour: np.ndarray, offset_s: float = 0.0) -> SignalClock:
    """Return a clock whose greens all have priority."""
    nowhere = np.zeros(colour.shape, bool)
    return make_clock(duration_s, colour, nowhere, nowhere, offset_s)


def evaluate(clock: SignalClock, time_s: float) -> tuple[int, np.ndarray]:
    """Return the phase and ``[4, P, Q]``: colour, time left, second and third green."""
    signal = np.zeros(clock.green_s.shape, Shown)
    tables = clock_tables(clock)
    words = directory(tables, CLOCK)
    phase = _evaluate(words.ctypes.data, time_s, signal)
    return phase, np.stack([signal[name] for name in ("colour", "change_s", "second_green_s", "third_green_s")])


open_clock = opener(CLOCK)


@compiled
def _evaluate(clock_at, time_s, signal):  # type: ignore[no-untyped-def]
    clock = open_clock(clock_at)
    read_clock(time_s, clock, signal)
    return phase_of_step(time_s + 0.001, clock)


def driven(clock: SignalClock, time_s: float) -> int:
    """Return the phase that vehicles drove by in the step that ended at ``time_s``."""
    return evaluate(clock, time_s - 0.001)[0]


@pytest.fixture
def clock(road: RoadNet) -> SignalClock:
    return road.clock


def test_green_and_red_per_cycle(clock: SignalClock) -> None:
    assert clock.cycle_s == 65.0 and clock.offset_s == 7.0
    assert clock.green_s.tolist() == [[0.0, 36.0, 30.0], [20.0, 0.0, 20.0]]
    assert (clock.red_s + clock.green_s == 65.0).all()
    # Right on red is red, but legal.
    assert clock.colour[1, 0].tolist() == [RED, RED, RED, RED, GREEN, YELLOW]
    assert clock.legal_on_red[1, 0].tolist() == [True] * 4 + [False] * 2
    assert not clock.legal_on_red[0].any()


# The plan starts at 7 s: through A green 0-30, A's left green 0-30 and 33-39, B green 42-62 of a cycle of 65 s.
@pytest.mark.parametrize(
    ("time_s", "movement", "expected"),
    [
        (7.0, (0, 2), (GREEN, 30.0, 65.0, 130.0)),
        (17.0, (0, 2), (GREEN, 20.0, 55.0, 120.0)),
        (37.0, (0, 2), (YELLOW, 3.0, 100.0, 165.0)),
        (47.0, (0, 2), (RED, 25.0, 90.0, 155.0)),
        (17.0, (0, 1), (GREEN, 20.0, 23.0, 55.0)),
        (38.0, (0, 1), (YELLOW, 2.0, 34.0, 67.0)),
        (41.0, (0, 1), (GREEN, 5.0, 31.0, 64.0)),
        (59.0, (0, 1), (RED, 13.0, 46.0, 78.0)),
        (8.0, (1, 0), (RED, 41.0, 106.0, 171.0)),
        (2.0, (1, 0), (GREEN, 2.0, 47.0, 112.0)),
        (52.0, (1, 2), (GREEN, 17.0, 62.0, 127.0)),
    ],
)
def test_by_hand(clock: SignalClock, time_s: float, movement: tuple[int, int], expected: tuple[float, ...]) -> None:
    _, state = evaluate(clock, time_s)
    assert state[:, movement[0], movement[1]] == pytest.approx(expected)


@pytest.mark.parametrize("step_s", [0.1, 0.35, 0.5, 0.7])
def test_a_cycle_ends_when_it_ends(step_s: float) -> None:
    """Whatever the floats of a time that is added up or multiplied say."""
    clock = plan(np.array([21.0, 21.0]), np.array([[[GREEN, RED]]], np.int8), offset_s=2.1)
    for step in range(3000):
        ms = round(1000 * step_s) * step
        expected = (ms - 2100) % 42000 // 21000
        assert evaluate(clock, step * step_s)[0] == expected, step


def test_against_brute_force() -> None:
    """Random plans, read off a timeline of half seconds."""
    generator = np.random.default_rng(3)
    for _ in range(40):
        phases = int(generator.integers(2, 7))
        duration = generator.integers(2, 20, phases).astype(float)
        colour = generator.integers(0, 3, (1, 1, phases)).astype(np.int8)
        clock = plan(duration, colour, float(generator.integers(-5, 30)))
        timeline = np.tile(np.repeat(colour[0, 0], (2 * duration).astype(int)), 6)
        starts = np.flatnonzero((timeline == GREEN) & (np.roll(timeline, 1) != GREEN))
        for tick in generator.integers(0, int(2 * clock.cycle_s), 5).tolist():
            _, state = evaluate(clock, clock.offset_s + tick / 2.0)
            assert state[0, 0, 0] == timeline[tick]
            changes = np.flatnonzero(timeline[tick:] != timeline[tick])
            assert state[1, 0, 0] == (min(changes[0] / 2.0, NEVER_S) if len(changes) else NEVER_S)
            if len(starts):
                greens = [0.0] if timeline[tick] == GREEN else []
                greens += ((starts[starts > tick] - tick) / 2.0).tolist()
                assert state[2:, 0, 0].tolist() == [min(time_s, NEVER_S) for time_s in greens[1:3]]


def follow_sumo(road: RoadNet, folder: Path, duration_s: float) -> int:
    """Compare the clock with the state that SUMO's signal has in every step; return in how many it switches."""
    routes = folder / "none.rou.xml"
    routes.write_text("<routes/>")
    libsumo, session = import_libsumo(), SumoSession()
    session.load(sumo_arguments(road.path, routes, 0, 0.5))
    try:
        links = signal_links(road)
        switches = 0
        letters = {"G": GREEN, "g": GREEN, "y": YELLOW, "Y": YELLOW, "r": RED, "u": RED, "s": RED}
        while session.time_s < duration_s:
            before = session.time_s
            session.advance()
            # What SUMO reports after a step is the state that was in force during it.
            state = libsumo.trafficlight.getRedYellowGreenState("TL")
            phase, ours = evaluate(road.clock, before)
            last = driven(road.clock, session.time_s)
            switches += last != phase
            for (p, q), indices in links.items():
                shown = min(letters[state[link]] for link in indices)
                assert road.clock.colour[p, q, last] == shown, (before, p, q)
                assert ours[0, p, q] == shown or last != phase, (before, p, q)
    finally:
        session.close()
    return switches


def signal_links(road: RoadNet) -> dict[tuple[int, int], list[int]]:
    links: dict[tuple[int, int], list[int]] = {}
    for connection in ElementTree.parse(road.path).getroot().findall("connection"):
        if connection.get("tl") == "TL" and connection.get("to").startswith("TL2"):
            key = road.approaches.index(connection.get("from")[0]), road.exits.index(connection.get("to")[3])
            links.setdefault(key, []).append(int(connection.get("linkIndex")))
    return links


def built(folder: Path, change: Callable[[str], str]) -> RoadNet:
    """Return a procedural intersection whose main program ``change`` has changed."""
    text = build_net(procedural_context().intersection).read_text()
    program = re.search(r' *<tlLogic id="TL".*?</tlLogic>', text, re.DOTALL)
    assert program is not None
    path = folder / "net.net.xml"
    path.write_text(text.replace(program.group(0), change(program.group(0))))
    return read_road(path)


@pytest.mark.parametrize(("green_s", "cycle_s", "switches"), [("26.27", 58.54, 10), ("25.99951", 58.0, 0)])
def test_phases_begin_as_in_sumo(green_s: str, cycle_s: float, switches: int, tmp_path: Path) -> None:
    """Between two steps, where vehicles drive by what SUMO shows after the step; times are whole milliseconds."""
    road = built(tmp_path, lambda program: re.sub(r'duration="26(\.0+)?"', f'duration="{green_s}"', program))
    assert road.clock.cycle_s == pytest.approx(cycle_s, abs=1e-9)
    assert follow_sumo(road, tmp_path, 300.0) >= switches


@pytest.mark.parametrize(
    ("old", "values", "message"),
    [
        ('duration="26"', ("0.0004", "-3", "nan", "inf"), "program TL has a phase without a positive duration"),
        ('offset="0"', ("inf", "nan", "1e400", "late"), "is not a complete SUMO net"),
    ],
)
def test_times_that_are_none_are_refused(old: str, values: tuple[str, ...], message: str, tmp_path: Path) -> None:
    for value in values:
        with pytest.raises(IzooError, match=message):
            built(tmp_path, functools.partial(re.sub, old, f'{old.split("=")[0]}="{value}"'))


def test_against_sumo_on_published_nets(dataset: ContextList, tmp_path: Path) -> None:
    paths = sorted({str(context.intersection.net_path) for context in dataset})
    for path in paths[::12]:
        follow_sumo(read_road(path), tmp_path, 130.0)
