import itertools

import pytest

from izoo.contexts.cities.plans import MAX_CYCLE_S, Need, build_plan, measure, yellow_time_s
from izoo.contexts.movements import conflict, deflection_deg, turn_of

BEARINGS = {"A": 0.0, "B": 90.0, "C": 180.0, "D": 270.0}


def _plan(*requirements):
    """The plan of a cross for what each leg needs: phases, share of green, and whether lefts have their own."""
    needs = {}
    for (leg, bearing), (phase_count, share, *own_left) in zip(BEARINGS.items(), requirements, strict=True):
        exits = {turn_of(bearing, there): ((other, there),) for other, there in BEARINGS.items() if other != leg}
        needs[leg] = Need(bearing, {turn: exits[turn] for turn in "rsl"}, phase_count, share, *(own_left or [True]))
    return build_plan([("A", "C"), ("B", "D")], needs, 3.0)


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


@pytest.mark.parametrize(
    "requirements",
    [
        [(1, 0.50), (1, 0.42), (1, 0.50), (1, 0.42)],
        [(2, 0.40), (2, 0.45), (2, 0.40), (2, 0.45)],
        [(2, 0.90), (1, 0.15), (2, 0.88), (1, 0.15)],
        [(3, 0.60), (1, 0.30), (2, 0.55), (1, 0.25)],
        [(1, 0.30), (1, 0.28), (1, 0.25), (1, 0.20)],
        [(2, 0.40, False), (1, 0.45), (1, 0.40), (1, 0.45)],
    ],
)
def test_requirements_are_met(requirements):
    plan = _plan(*requirements)
    assert plan.cycle_s <= MAX_CYCLE_S
    for leg, (phase_count, share, *_) in zip(BEARINGS, requirements, strict=True):
        got_count, got_share = measure(plan, leg)
        assert got_count == phase_count
        assert got_share == pytest.approx(share, abs=0.012)


def test_impossible_shares_are_cut_not_stretched():
    plan = _plan((1, 0.8), (1, 0.4), (1, 0.8), (1, 0.4))
    shares = [measure(plan, leg)[1] for leg in "AB"]
    assert plan.cycle_s == pytest.approx(MAX_CYCLE_S, abs=1.0)
    assert shares[0] / shares[1] == pytest.approx(2.0, rel=0.05)
    assert sum(shares) == pytest.approx(1.0 - 6.0 / plan.cycle_s, abs=0.01)


def test_protected_lefts_have_their_own_phase():
    plan = _plan((2, 0.4), (2, 0.45), (2, 0.4), (2, 0.45))
    lefts = [phase for phase in plan.phases if ("A", "B", "G") in phase.states]
    assert len(plan.phases) == 8
    assert {state for state in lefts[0].states if state[2] != "s"} == {("A", "B", "G"), ("C", "D", "G")}


def test_right_turns_show_right_on_red_and_greens_end_in_yellow():
    plan = _plan((1, 0.50), (1, 0.42), (1, 0.50), (1, 0.42))
    assert [dict.fromkeys(p.states) and p.duration_s for p in plan.phases][1::2] == [3.0, 3.0]
    assert ("B", "A", "s") in plan.phases[0].states
    for before, after in itertools.pairwise([*plan.phases, plan.phases[0]]):
        greens = {state[:2] for state in before.states if state[2] in "Gg"}
        shown = {state[:2]: state[2] for state in after.states}
        assert all(shown.get(movement) in ("G", "g", "y") for movement in greens)


def test_yellow_is_longer_on_fast_roads():
    assert yellow_time_s([13.4, 17.0]) == 3.0
    assert yellow_time_s([13.4, 17.9]) == 4.0
