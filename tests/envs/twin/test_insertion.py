"""Vehicles enter the twin in the step in which they enter SUMO, and the same ones are dropped."""

import dataclasses
import re
import tempfile
from pathlib import Path

import numpy as np
import pytest

from izoo.benchmarks.fidelity.single_vehicle import Case, play_sumo
from izoo.envs.sumo.session import SumoSession, import_libsumo, sumo_arguments
from izoo.envs.twin.net.reader import twin_traffic
from izoo.envs.twin.runtime.layout import DROPPED
from izoo.envs.twin.runtime.simulation import TwinEpisode
from izoo.networks.road import read_road
from izoo.traffic.sampling import write_routes
from tests.envs.twin.crossroads import assert_same, build_crossroads, meeting
from tests.envs.worlds import cramped, crossing

pytestmark = pytest.mark.slow
STEPS = 180


@pytest.mark.parametrize("lanes", [3, 4])
def test_the_same_vehicles_are_dropped_as_in_sumo(lanes: int, capfd: pytest.CaptureFixture[str]) -> None:
    case = Case.of(cramped(lanes), 1, 90.0)
    play_sumo(case, STEPS)
    theirs = {int(name) for name in re.findall(r"Vehicle '(\d+)' will not be able to depart", capfd.readouterr().err)}
    net = case.world.net
    episode = TwinEpisode(net, twin_traffic(case.traffic, read_road(Path(case.net_path)), net))
    for _ in range(STEPS):
        episode.step()
    ours = set(np.flatnonzero(episode.state.vehicles["status"] == DROPPED).tolist())
    assert len(theirs) > 3
    assert ours == theirs


def test_vehicles_wait_for_a_red_light_that_is_too_near_to_stop() -> None:
    case = Case.of(cramped(1), 1, 60.0)
    sumo = assert_same(case, 120)
    entered = (sumo.lane >= 0).argmax(axis=0)[(sumo.lane >= 0).any(axis=0)]
    due = np.ceil(2.0 * case.traffic.depart_s[(sumo.lane >= 0).any(axis=0)])
    assert (entered - due > 20).any()


ROOM_M = {"AB": 40.0, "AD": 20.0}
"""Room that SUMO reserves for left turns, which begin on the right here, and for right turns, from the left."""
BEYOND_M = (-12.0, 0.0, 0.4, 0.6, 2.4, 2.6, 4.9, 5.1, 10.0, 12.0, 12.1, 14.4, 16.7, 16.8, 25.0)
"""From the front of a vehicle that enters to the room for its changes."""


@pytest.fixture(scope="module")
def three_lanes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A crossroads with sources of 8.1 m that show red for 10 s at their end; the road behind is ``ROAD`` long."""
    path = build_crossroads(tmp_path_factory.mktemp("three"), [(100.0, "G" * 20)], lanes=3, options=("--tls.set", "A"))
    text = path.read_text()
    links = text.count(' tl="A"')
    phases = f'<phase duration="10" state="{"r" * links}"/><phase duration="90" state="{"G" * links}"/>'
    text = re.sub(r'(<tlLogic id="A".*?>).*?(</tlLogic>)', rf"\g<1>{phases}\g<2>", text, flags=re.DOTALL)
    for edge, length in (("AB2A", "8.1"), ("A2TL", "ROAD")):
        text = re.sub(rf'(<lane id="{edge}_\d".*? length=)"[\d.]+"', rf'\g<1>"{length}"', text)
    path.write_text(text)
    return path


@pytest.mark.parametrize("way", ROOM_M)
@pytest.mark.parametrize("step_ms", [100, 500, 1000])
def test_vehicle_that_must_change_twice_enters_if_its_first_step_ends_in_the_reserved_room(
    way: str, step_ms: int, three_lanes: Path, tmp_path: Path
) -> None:
    """Further away it is dropped if it could not stop, once the light is green: until then it waits."""
    entered, steps = [], 60_000 // step_ms
    for beyond_m in BEYOND_M:
        path = tmp_path / f"{beyond_m}.net.xml"
        path.write_text(three_lanes.read_text().replace("ROAD", f"{ROOM_M[way] + beyond_m + 5.1 - 8.1:.2f}"))
        first = {"depart": 0.0, "way": way, "lane": 0 if way == "AB" else 2}
        others = {"depart": 3.0, "decel_mps2": 2.0}, {"depart": 30.0, "tau_s": 0.3}
        case = dataclasses.replace(meeting(path, [first, *(first | other for other in others)]), step_ms=step_ms)
        sumo = assert_same(case, steps, 1e-6)
        assert not (sumo.lane[: 10_000 // step_ms] >= 0).any()
        entered.append((sumo.lane[:, 0] >= 0).any())
    into = np.array(BEYOND_M) < 5.0 * step_ms / 1000.0
    assert np.array(entered)[into].all() and entered[-1] and not np.array(entered)[~into][0]


def test_the_route_file_is_read_in_portions() -> None:
    """The fleet's extremes are those of the vehicle types that SUMO has read so far."""
    case = Case.of(crossing(lane_count=3, approach=None), 3, 600.0)
    fleet = twin_traffic(case.traffic, read_road(case.net_path), case.world.net).fleet
    libsumo, session = import_libsumo(), SumoSession()
    with tempfile.TemporaryDirectory() as folder:
        routes = Path(folder) / "traffic.rou.xml"
        write_routes(case.traffic, read_road(case.net_path), routes)
        session.load(sumo_arguments(case.net_path, routes, case.seed, 0.5))
        for step in range(1000):
            session.advance()
            # SUMO has three types of its own, whose names begin with DEFAULT.
            names = [name for name in libsumo.vehicletype.getIDList() if not name.startswith("DEFAULT")]
            row = fleet[fleet["from_ms"] <= 500.0 * step][-1]
            assert row["decel"] == min(map(libsumo.vehicletype.getDecel, names)), step
            assert row["min_gap"] == max(map(libsumo.vehicletype.getMinGap, names)), step
        session.close()
    assert len(fleet) > 3 and len(np.unique(fleet["min_gap"])) > 1
