"""Whether a CV can enter in a context at all; that none enters in an episode may be chance."""

from __future__ import annotations

from collections.abc import Iterable

from izoo.contexts.context import Context
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road

EPISODES_SEARCHED = 1000
"""Episodes of a schedule that are searched for one in which a CV can enter."""
_DEPART_M = 20.0
"""A vehicle departs at most this far along its source edge: its own length."""


def first_with_cvs(config: EnvConfig, episodes: Iterable[tuple[int, Context]]) -> int:
    """Return the number of the first episode in which a CV can enter the region.

    Args:
        config: settings of the environment.
        episodes: numbers and contexts of the episodes to come.

    Raises:
        IzooError: there is none; the message names the reason in the last one.
    """
    reason = None
    for number, context in episodes:
        reason = why_no_cv(config, context)
        if reason is None:
            return number
    raise IzooError(
        f"no controlled vehicle entered, and none can: {reason}; choose contexts with more demand or a higher "
        "adoption, or a longer horizon_s."
    )


def why_no_cv(config: EnvConfig, context: Context) -> str | None:
    """Return why no CV can ever enter in a context; ``None`` where one can, however rarely."""
    if context.adoption <= 0.0:
        return f"the adoption of {context.name} is 0"
    if not context.demand_approaches:
        return f"{context.name} has no demand"
    road = read_road(build_net(context.intersection))
    ways_s = [
        (length_m - _DEPART_M) / road.speed_limit_mps[road.approaches.index(leg)]
        for leg in context.demand_approaches
        for length_m in road.source_length_m[road.approaches.index(leg)].values()
    ]
    if not ways_s:
        return f"{context.name} has no street on which its demand could come"
    simulated_s = (config.warmup_steps + config.total_steps) * config.step_s
    if min(ways_s) >= simulated_s:
        return f"the way to {context.name} takes {min(ways_s):.0f} s, and {simulated_s:g} s are simulated"
    return None
