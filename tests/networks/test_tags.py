"""What the tags of a way say: lanes and turns of a direction, and speed limits."""

import pytest

from izoo.networks.osm.streets import Way
from izoo.networks.osm.tags import Lanes, assign_turns, lanes_towards, parse_speed, speed_limit

_LTR, _BIKE, _YES = "left|through|through;right", "no|no|designated|no", "yes|yes|yes"


def way(oneway: int = 0, highway: str = "primary", **tags: str) -> Way:
    return Way(1, (1, 2), {"highway": highway, **{key.replace("__", ":"): v for key, v in tags.items()}}, oneway)


@pytest.mark.parametrize(
    ("street", "arriving", "expected"),
    [
        (way(lanes="4"), True, Lanes(("", ""))),
        (way(lanes="3"), True, Lanes(("", ""), guessed=True, left_lane=True)),
        (way(lanes="3"), False, Lanes(("",), guessed=True)),
        (way(lanes="5", lanes__both_ways="1"), True, Lanes(("", "", "l"))),
        (way(lanes="5", lanes__both_ways="1"), False, Lanes(("", ""))),
        (way(lanes="5", lanes__backward="2"), True, Lanes(("", "", ""))),
        (way(lanes__forward="3"), True, Lanes(("", "", ""))),
        (way(1, lanes="2", turn__lanes="left;through|right"), True, Lanes(("r", "sl"))),
        (way(turn__lanes__forward="left||"), True, Lanes(("", "", "l"))),
        (way(1), True, Lanes(("", ""), guessed=True)),
        (way(1, "residential"), True, Lanes(("",), guessed=True)),
        (way(lanes="two"), True, Lanes(("", ""), guessed=True)),
        (way(1, lanes="40"), True, Lanes(("",) * 6)),
        (way(lanes="8"), True, Lanes(("",) * 4)),
        (way(lanes="40"), False, Lanes(("",) * 6)),
        (way(lanes="7"), True, Lanes(("",) * 4, guessed=True, left_lane=True)),
        (way(lanes="7"), False, Lanes(("",) * 3, guessed=True)),
        (way(lanes="7", lanes__both_ways="1"), True, Lanes(("", "", "", "l"))),
        (way(lanes="7", lanes__backward="3"), True, Lanes(("",) * 4)),
        (way(lanes="1"), True, Lanes(("",), guessed=True)),
        (way(1, lanes="8", turn__lanes="left|||||||right"), True, Lanes(("r", "", "", "", "", ""))),
        # The lanes of the other direction are those that its turns tell.
        (way(lanes="4", turn__lanes__backward="left|through|through;right"), True, Lanes(("",))),
        (way(lanes="5", turn__lanes__backward="left|through|through;right"), False, Lanes(("", ""))),
        # Bus lanes are counted by ``lanes``, cycle lanes are not; both may be listed among turns.
        (way(1, lanes="3", turn__lanes=_LTR, vehicle__lanes="yes|yes|no"), True, Lanes(("s", "l"))),
        (way(1, lanes="3", turn__lanes=_LTR, bus__lanes="||designated"), True, Lanes(("s", "l"))),
        (way(1, lanes="3", turn__lanes=_LTR, psv__lanes="designated|yes|yes"), True, Lanes(("rs", "s"))),
        (way(1, lanes="3", turn__lanes="left|through", psv__lanes="yes|yes|designated"), True, Lanes(("s", "l"))),
        (way(1, lanes="2", turn__lanes="left|through", psv__lanes="yes|yes|designated"), True, Lanes(("s", "l"))),
        (way(1, lanes="3", access__lanes="yes|yes|bus"), True, Lanes(("", ""))),
        (way(1, lanes="3", motor_vehicle__lanes="yes|yes|destination"), True, Lanes(("", "", ""))),
        (way(1, lanes="3", bus__lanes="designated|yes|yes", motor_vehicle__lanes=_YES), True, Lanes(("",) * 3)),
        (way(1, lanes="3", turn__lanes="left|through|none|right", bicycle__lanes=_BIKE), True, Lanes(("r", "s", "l"))),
        (way(1, lanes="4", turn__lanes="left|through|none|right", bicycle__lanes=_BIKE), True, Lanes(("r", "s", "l"))),
        (way(1, lanes="3", turn__lanes="left|through|right", bicycle__lanes=_BIKE), True, Lanes(("r", "s", "l"))),
        (way(1, lanes="3", bicycle__lanes=_BIKE), True, Lanes(("", "", ""))),
        (way(1, bicycle__lanes=_BIKE), True, Lanes(("", "", ""))),
        (way(1, lanes="3", bus__lanes="yes|yes|yes|designated", bicycle__lanes=_BIKE), True, Lanes(("", ""))),
        (way(1, lanes="3", bus__lanes="yes|yes|designated", bicycle__lanes=_BIKE), True, Lanes(("", ""))),
        (way(lanes="4", lanes__psv__forward="1", lanes__forward="2"), True, Lanes(("",))),
        (way(lanes="4", lanes__bus__forward="1", lanes__backward="2"), True, Lanes(("",))),
        (way(lanes="6", busway="lane"), True, Lanes(("", ""))),
        (way(1, lanes="3", lanes__bus="1", turn__lanes=_LTR), True, Lanes(("s", "l"))),
        (way(1, lanes="3", lanes__bus="1", turn__lanes="left|through"), True, Lanes(("s", "l"))),
        (way(lanes="5", bus__lanes__forward="yes|yes|designated", lanes__backward="2"), True, Lanes(("", ""))),
    ],
)
def test_lanes_of_a_direction(street: Way, arriving: bool, expected: Lanes) -> None:
    assert lanes_towards(street, 1, arriving=arriving) == expected


@pytest.mark.parametrize(
    ("lanes", "available", "banned", "expected"),
    [
        (("",), "rsl", "", ("rsl",)),
        (("", ""), "rsl", "", ("rs", "sl")),
        (("", "", ""), "rl", "", ("r", "r", "l")),
        (("", ""), "l", "", ("l", "l")),
        (("r", "s", "l"), "rsl", "", ("r", "s", "l")),
        (("", "", "l"), "rsl", "", ("rs", "s", "l")),
        (("rs", "sl"), "rl", "", ("r", "l")),
        (("", ""), "rsl", "l", ("rs", "s")),
        (("s",), "s", "s", ("s",)),
    ],
)
def test_turns_fit_the_exits(lanes: tuple[str, ...], available: str, banned: str, expected: tuple[str, ...]) -> None:
    assert assign_turns(Lanes(lanes), frozenset(available), frozenset(banned))[0] == expected


SPEEDS = {
    **{"30 mph": 13.4112, "50": 50 / 3.6, "50 km/h": 50 / 3.6, "30mph; 20 mph": 13.4112, "walk": 7 / 3.6},
    **dict.fromkeys(("DE:zone30", "DE:zone:30", "FR:zone30"), 30 / 3.6),
    **{"GB:zone20": 20 * 0.44704, **dict.fromkeys(("none", "US:urban", "RO:urban", "signals", "999", None))},
}


@pytest.mark.parametrize("text", SPEEDS)
def test_speed_limits(text: str | None) -> None:
    assert parse_speed(text) == pytest.approx(SPEEDS[text])


@pytest.mark.parametrize(
    ("street", "direction", "expected"),
    [
        (way(maxspeed="50", maxspeed__backward="30"), 1, (50 / 3.6, False)),
        (way(maxspeed="50", maxspeed__backward="30"), -1, (30 / 3.6, False)),
        (way(maxspeed="signals"), 1, (35 * 0.44704, True)),
        (way(zone__maxspeed="DE:30"), 1, (30 / 3.6, False)),
        (way(maxspeed="50", maxspeed__type="DE:zone30"), 1, (50 / 3.6, False)),
    ],
)
def test_which_limit_counts(street: Way, direction: int, expected: tuple[float, bool]) -> None:
    assert speed_limit(street, direction) == pytest.approx(expected)
