"""Nets with features that only SUMO supports are refused by name; the last program of a signal is played."""

import re
from pathlib import Path

import pytest

from izoo.benchmarks.fidelity.single_vehicle import Case
from izoo.envs.twin.net.reader import read_twin_world
from izoo.errors import IzooError
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from izoo.traffic.sampling import sample_traffic
from tests.envs.twin.crossroads import assert_same
from tests.envs.worlds import crossing

LANE = '<lane id="A2TL_0"'
CHANGES = {
    "actuated": ('type="static"', 'type="actuated"', "is of type actuated; the twin plays static programs only"),
    "phases in another order": ("<phase ", '<phase next="0" ', "a phase with next='0'; the twin plays phases in their"),
    "red and yellow": ('state="r', 'state="u', "shows 'u'; the twin knows the letters G g y Y r s"),
    "blinking": ('state="G', 'state="o', "shows 'o'"),
    "a lane that cars must keep": (LANE, f'{LANE} changeLeft="bus"', "lane A2TL_0 has changeLeft='bus'"),
    "a lane that all must keep": (LANE, f'{LANE} changeRight=""', "lane A2TL_0 has changeRight=''"),
    "a bus lane": (LANE, f'{LANE} allow="bus taxi"', "lane A2TL_0 has allow='bus taxi'"),
    "a lane without cars": (LANE, f'{LANE} disallow="passenger truck"', "has disallow='passenger truck'"),
    "an edge's stop offset": (LANE, f'<stopOffset value="3"/>{LANE}', "edge A2TL has a stopOffset"),
    "a lane's stop offset": (f"({LANE}[^>]*)/>", r'\1><stopOffset value="3"/></lane>', "edge A2TL has a stopOffset"),
    "visibility": ("<connection ", '<connection visibility="30" ', "has visibility='30'; on the twin drivers .* 4.5"),
    "a junction that may be blocked": ("<connection ", '<connection keepClear="0" ', "has keepClear='0'"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_unsupported_features_are_refused(tmp_path: Path, name: str) -> None:
    old, new, message = CHANGES[name]
    text, count = re.subn(old, new, build_net(crossing().intersection).read_text(), count=1)
    assert count == 1
    with pytest.raises(IzooError, match=rf"net\.net\.xml: .*{message}.*\. Use simulator=sumo\.$"):
        read(_written(tmp_path, text))


def test_the_last_program_of_a_signal_is_played(tmp_path: Path) -> None:
    """As SUMO does, and the MDP's clock."""
    context = crossing(lane_count=1, phase_count=1, approach="A")
    text = build_net(context.intersection).read_text()
    program = re.search(r' *<tlLogic id="TL".*?</tlLogic>', text, re.DOTALL).group(0)  # type: ignore[union-attr]
    other = program.replace('programID="0"', 'programID="other"').replace('offset="', 'offset="1')
    other = other.replace('duration="2', 'duration="3')
    path = _written(tmp_path, text.replace(program, f"{program}\n{other}"))
    road = read_road(path)
    world = read_twin_world(road, path)
    assert len(world.program_ids) == len(world.net.programs) == len(set(world.program_ids))
    main = world.net.programs[world.program_ids.index("TL")]
    assert main["cycle_ms"] == 1000 * road.clock.cycle_s
    assert main["offset_ms"] == 1000 * road.clock.offset_s
    case = Case(world, path, sample_traffic(context, road, 3, 120.0), 3)
    assert (assert_same(case, 300).lane >= 0).sum() > 500


def test_restrictions_of_other_vehicles_than_cars_are_read(tmp_path: Path) -> None:
    text = build_net(crossing().intersection).read_text()
    text = text.replace(LANE, f'{LANE} changeLeft="passenger bus" changeRight="all" disallow="tram pedestrian"')
    read(_written(tmp_path, text.replace("<connection ", '<connection visibility="4.50" keepClear="1" ')))


def _written(folder: Path, text: str) -> Path:
    path = folder / "net.net.xml"
    path.write_text(text)
    return path


def read(path: Path) -> None:
    """Read a net for the twin."""
    read_twin_world(read_road(path), path)
