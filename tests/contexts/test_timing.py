"""Which movements of a cross are in conflict, and how long yellow is."""

import pytest

from izoo.contexts.cities.plans import yellow_time_s
from izoo.contexts.movements import conflict, deflection_deg, turn_of


def test_turns_of_a_cross():
    assert [turn_of(0.0, bearing) for bearing in (90.0, 180.0, 270.0)] == ["l", "s", "r"]
    assert deflection_deg(0.0, 0.0) == 180.0


@pytest.mark.parametrize(
    ("one", "two", "expected"),
    [
        (((0, 180)), (180, 0), False),  # opposite straights
        (((0, 180)), (90, 270), True),  # crossing straights
        (((0, 180)), (180, 270), True),  # left against oncoming traffic
        (((0, 90)), (180, 270), False),  # opposite lefts
        (((0, 270)), (180, 270), True),  # merging
        (((0, 270)), (180, 0), False),  # right and oncoming traffic
        (((0, 180)), (0, 90), False),  # same approach
    ],
)
def test_conflicts_of_a_cross(one, two, expected):
    assert conflict(one, two) is expected
    assert conflict(two, one) is expected


def test_yellow_is_longer_on_fast_roads():
    assert yellow_time_s([13.4, 17.0]) == 3.0
    assert yellow_time_s([13.4, 17.9]) == 4.0
