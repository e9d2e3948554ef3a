"""Blinkers: the side to which a vehicle wants to change, or turns soon."""

from __future__ import annotations

from izoo.envs.tables import compiled
from izoo.envs.twin.driving.car_following import desired_speed
from izoo.envs.twin.lane_change.flags import COOPERATIVE, LEFTWARD, RIGHT_KEEPING, RIGHTWARD, STRATEGIC

_RIGHT, _LEFT = 1, 2
"""Bits of ``signals``, with the values that SUMO's ``vehicle.getSignals`` reports."""
_AHEAD_S = 7.0
"""A vehicle blinks before a turn that it reaches within this time at its desired speed."""
_MORE_THAN_SPEED = STRATEGIC | COOPERATIVE | RIGHT_KEEPING
_LEFT_TURNS, _RIGHT_TURNS = tuple(map(ord, "lLt")), tuple(map(ord, "rR"))


@compiled
def blinkers(net, state, v):  # type: ignore[no-untyped-def]
    """Return the blinkers of vehicle ``v``, which has just moved and not changed lanes since.

    Requests of the step before come first, except keeping right, for which vehicles do not blink. With requests to both
    sides it blinks to the left if those are for speed alone, otherwise to the right.
    """
    state_bits = state.vehicles[v].change_state
    rightward, leftward = state_bits & RIGHTWARD, state_bits & LEFTWARD
    if leftward and not (rightward and state_bits & _MORE_THAN_SPEED):
        return _LEFT
    if rightward and not state_bits & RIGHT_KEEPING:
        return _RIGHT
    lane = state.vehicles[v].lane
    left_m = net.lanes[lane].length - state.vehicles[v].position
    if left_m >= _AHEAD_S * desired_speed(net, state, v, lane):
        return 0
    link = net.best[state.vehicles[v].variant, lane].link
    if link < 0:
        return 0
    turn = net.links[link].direction
    if turn in _LEFT_TURNS:
        return _LEFT
    return _RIGHT if turn in _RIGHT_TURNS else 0
