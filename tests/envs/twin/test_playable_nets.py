"""Nets with features that SUMO honours and the twin does not know are refused by name, and all others are read."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from izoo.contexts.catalogue import Scenario, build
from izoo.contexts.procedural import SYSTEMATICITY_TRAIN
from izoo.contexts.source import ContextList
from izoo.envs.twin.whole_net import read_twin_world
from izoo.errors import IzooError
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
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
    "visibility": (
        "<connection ",
        '<connection visibility="30" ',
        "has visibility='30'; on the twin drivers see .* 4.5 m",
    ),
    "a junction that may be blocked": ("<connection ", '<connection keepClear="0" ', "has keepClear='0'"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_the_twin_does_not_know_is_refused(tmp_path: Path, name: str) -> None:
    old, new, message = CHANGES[name]
    text, count = re.subn(old, new, build_net(crossing().intersection).read_text(), count=1)
    assert count == 1
    with pytest.raises(IzooError, match=rf"net\.net\.xml: .*{message}.*\. Use simulator=sumo\.$"):
        read(_written(tmp_path, text))


def test_what_restricts_no_car_is_played(tmp_path: Path) -> None:
    text = build_net(crossing().intersection).read_text()
    text = text.replace(LANE, f'{LANE} changeLeft="passenger bus" changeRight="all" disallow="tram pedestrian"')
    read(_written(tmp_path, text.replace("<connection ", '<connection visibility="4.50" keepClear="1" ')))


def test_built_nets_are_played() -> None:
    rng = np.random.default_rng(0)
    contexts = [SYSTEMATICITY_TRAIN.sample(rng) for _ in range(4)]
    contexts += [
        build(Scenario(city, 7, "summer", 0.5, "peak", "combustion")) for city in ("atlanta", "salt_lake_city")
    ]
    for context in contexts:
        read(build_net(context.intersection))


def test_measured_nets_are_played(dataset: ContextList) -> None:
    paths = {build_net(context.intersection) for context in dataset}
    assert len(paths) == 60
    for path in sorted(paths)[::6]:
        read(path)


def _written(folder: Path, text: str) -> Path:
    path = folder / "net.net.xml"
    path.write_text(text)
    return path


def read(path: Path) -> None:
    """Read a net for the twin."""
    read_twin_world(read_road(path), path)
