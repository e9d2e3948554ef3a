"""Lane connections, and what cannot be built, without running anything."""

import pytest

from izoo.contexts.spec import GhostSpec, IntersectionSpec, SignalPlan
from izoo.errors import IzooError
from izoo.networks.net.connections import signal_links
from izoo.networks.net.plain import plain_net
from izoo.networks.signals.search import search_plan
from tests.networks.worlds import CROSS, intersection, with_approaches


def write(spec: IntersectionSpec, plan: SignalPlan | None = None):
    return plain_net(spec, plan or search_plan(spec))


def paths(spec: IntersectionSpec, leg: str) -> list[tuple[int, str, int]]:
    return [(link.from_lane, link.to_leg, link.to_lane) for link in signal_links(spec) if link.from_leg == leg]


def test_turns_lead_to_the_legs_at_their_side():
    spec = with_approaches(intersection(CROSS, 3), "A", lanes=("r", "s", "l"))
    assert paths(spec, "A") == [(0, "D", 0), (1, "C", 0), (2, "B", 2)]


def test_surplus_lanes_merge_and_lefts_keep_left():
    spec = with_approaches(intersection(CROSS, 2, 2), "A", lanes=("s", "s", "s", "l", "l"))
    assert paths(spec, "A") == [(0, "C", 0), (1, "C", 1), (2, "C", 1), (3, "B", 0), (4, "B", 1)]
    spec = with_approaches(intersection(CROSS, 2, 4), "A", lanes=("rs", "sl"))
    assert paths(spec, "A") == [(0, "D", 0), (0, "C", 0), (1, "C", 1), (1, "B", 3)]


@pytest.mark.parametrize("lane_count", [1, 2, 3, 5])
def test_several_exits_in_one_turn_are_all_reached_without_crossing(lane_count):
    # Legs B and C both lie to the left of A, D and E to its right.
    spec = with_approaches(intersection((0.0, 72.0, 110.0, 250.0, 288.0), 2), "A", lanes=("r",) * lane_count)
    reached = paths(spec, "A")
    assert {leg for _, leg, _ in reached} == {"D", "E"}
    assert {lane for lane, _, _ in reached} == set(range(lane_count))
    # E is the sharper turn, so its lanes lie to the right of those that lead to D.
    assert max(lane for lane, leg, _ in reached if leg == "E") <= min(lane for lane, leg, _ in reached if leg == "D")


FOUR = {"lanes": ("r", "s", "s", "l"), "right_pockets": 1, "left_pockets": 1}
TOO_LONG = with_approaches(intersection(CROSS, 2), "A", **FOUR, pocket_length_m=295.0)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (with_approaches(intersection((0.0, 90.0, 180.0), 2), "A", lanes=("rs", "s")), "A may go right, but no leg"),
        (TOO_LONG, r"approach A of 300 m has turn pockets of 295 m"),
        (intersection(CROSS, 1, ghosts=GhostSpec(cross_green_s=0.0)), "ghost"),
        (intersection(CROSS, 1, ghosts=GhostSpec(straight_source_length_m=2.0)), "ghost"),
    ],
)
def test_what_cannot_be_built_is_refused(spec, message):
    with pytest.raises(IzooError, match=message):
        write(spec)
