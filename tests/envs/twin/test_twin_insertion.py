"""Vehicles enter the twin in the step in which they enter SUMO, and the same ones are dropped."""

from __future__ import annotations

import dataclasses
import re
import tempfile
from pathlib import Path

import numpy as np
import pytest

from izoo.benchmarks.oracle import Case, first_departure, play_sumo, play_twin
from izoo.contexts.context import Context
from izoo.envs.sumo.session import SumoSession, import_libsumo, sumo_arguments
from izoo.envs.twin.arrays import DROPPED, FLEET_DECEL, FLEET_FROM_MS, FLEET_MIN_GAP
from izoo.envs.twin.twin_episode import TwinEpisode
from izoo.envs.twin.whole_net import twin_traffic
from izoo.networks.road import read_road
from izoo.traffic.sampling import write_routes
from tests.envs.worlds import crossing

pytestmark = pytest.mark.slow
STEPS = 180


def cramped(lanes: int, road_m: float, source_m: float) -> Context:
    """Legs and sources too short for the lane changes that some vehicles need, and to stop at a red light."""
    context = crossing(lane_count=lanes, lane_length_m=60.0)
    spec = context.intersection
    legs = tuple(
        dataclasses.replace(leg, approach=dataclasses.replace(leg.approach, length_m=road_m)) if leg.approach else leg
        for leg in spec.legs
    )
    ghosts = dataclasses.replace(spec.ghosts, straight_source_length_m=source_m, turning_source_length_m=source_m)
    return context.replace(
        intersection=dataclasses.replace(spec, name="cramped", source="osm", legs=legs, ghosts=ghosts)
    )


@pytest.mark.parametrize("lanes", [3, 4])
def test_the_vehicles_that_sumo_drops_are_dropped(lanes: int, capfd: pytest.CaptureFixture[str]) -> None:
    case = Case.of(cramped(lanes, 40.0, 10.0), 1, 90.0)
    play_sumo(case, STEPS)
    theirs = {int(name) for name in re.findall(r"Vehicle '(\d+)' will not be able to depart", capfd.readouterr().err)}
    net = case.world.net
    episode = TwinEpisode(net, twin_traffic(case.traffic, read_road(Path(case.net_path)), net))
    for _ in range(STEPS):
        episode.step()
    ours = set(np.flatnonzero(episode.status == DROPPED).tolist())
    assert len(theirs) > 3
    assert ours == theirs


def test_vehicles_wait_for_a_red_light_that_is_too_near_to_stop() -> None:
    case = Case.of(cramped(1, 40.0, 10.0), 1, 60.0)
    sumo, twin = play_sumo(case, 120), play_twin(case, 120)
    assert first_departure(case, sumo, twin) is None
    entered = (sumo.lane >= 0).argmax(axis=0)[(sumo.lane >= 0).any(axis=0)]
    due = np.ceil(2.0 * case.traffic.depart_s[(sumo.lane >= 0).any(axis=0)])
    assert (entered - due > 20).any(), "nobody had to wait"


def test_the_route_file_is_read_in_portions() -> None:
    """What vehicles have in common, and from when on, are those whose types SUMO knows."""
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
            row = fleet[fleet[:, FLEET_FROM_MS] <= 500.0 * step][-1]
            assert row[FLEET_DECEL] == min(map(libsumo.vehicletype.getDecel, names)), step
            assert row[FLEET_MIN_GAP] == max(map(libsumo.vehicletype.getMinGap, names)), step
        session.close()
    assert len(fleet) > 3 and len(np.unique(fleet[:, FLEET_MIN_GAP])) > 1
