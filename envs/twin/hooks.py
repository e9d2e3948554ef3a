"""Right of way and lane changing that let everything pass and leave everybody where he is."""

from __future__ import annotations

from izoo.envs.twin.compiled import compiled
from izoo.envs.twin.signals import RED
from izoo.envs.twin.state import ITEM_LINK


@compiled
def limit_by_foes(net, traffic, state, v, link, distance_m, best, passing, request, step_s):  # type: ignore[no-untyped-def]
    """Return the speeds as they are."""
    return best, passing, request


@compiled
def may_pass(net, traffic, state, item, step_ms):  # type: ignore[no-untyped-def]
    """Return whether the link is not red."""
    return state.link_letter[state.item_ints[item, ITEM_LINK]] != RED


@compiled
def keep_clear(net, traffic, state, v):  # type: ignore[no-untyped-def]
    """Leave the items as they are."""


@compiled
def advise(net, traffic, state, v, low, wish, high, step_s):  # type: ignore[no-untyped-def]
    """Return the speed as it is."""
    return wish


@compiled
def change_lanes(net, traffic, state, step_ms):  # type: ignore[no-untyped-def]
    """Leave everybody where he is."""
