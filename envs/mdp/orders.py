"""From actions to what the simulator is told, in compiled code."""

from __future__ import annotations

import numpy as np

from izoo.compiling import compiled
from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2
from izoo.envs.mdp.state import APPROACH, COMMANDED, DEFERRED, LOCATION, SPEED, TARGET, YIELDING
from izoo.envs.mdp.tally import METRIC
from izoo.networks.road import INSIDE

LANE_CHANGE_BRAKING_MPS2 = 0.5
"""A CV is left to its driver while it is on a lane that does not lead to its exit and that driver itself braked it
harder than this in the last step: it is slowed to find a gap, and a command would override that."""
_AGENT_STEPS = METRIC["agent_steps"]
_DEFERRED_STEPS = METRIC["deferred_steps"]
_NAN_ACTIONS = METRIC["nan_actions"]
_LANE_CHANGE_DEFERRED = METRIC["lane_change_deferred"]
_JUNCTION_DEFERRED = METRIC["junction_deferred"]


@compiled(borrows=True)
def plan_commands(agent_row, acting, action, defer, step_s, floats, ints, flags, sums, command, release, target):  # type: ignore[no-untyped-def]
    """Sort the agents into those whose speed is commanded and those left to the simulator's own driver.

    A CV inside the junction is always left to its driver: vehicles that are made to stand there are hit from the side,
    which none of SUMO's checks prevents. So is one that the driver slows for a lane change (``YIELDING``). A command
    holds until the next one, so one that would repeat the last, as in a queue, is left out.

    Args:
        agent_row: ``[A]`` rows of the agents, below 0 in empty slots.
        acting: ``[A]`` the same for those whom the actions are for; others have come since they were chosen.
        action: ``[A]`` m/s^2; NaN counts as defer.
        defer: ``[A]`` asked to be left to their own driver.
        command, release: ``[A]`` outputs: rows with a new command, and rows that were commanded and no longer are.
        target: ``[A]`` output: speed in m/s for each commanded row.

    Returns:
        How many rows have a new command, and how many are released.
    """
    commands, releases = 0, 0
    for a in range(agent_row.shape[0]):
        r = agent_row[a]
        if r < 0:
            continue
        p = ints[r, APPROACH]
        sums[p, _AGENT_STEPS] += 1
        newcomer = acting[a] < 0
        lost = not newcomer and np.isnan(action[a])
        asked = newcomer or defer[a] != 0
        if lost:
            sums[p, _NAN_ACTIONS] += 1
        inside = ints[r, LOCATION] == INSIDE
        if not asked and not lost:
            sums[p, _LANE_CHANGE_DEFERRED] += flags[r, YIELDING]
            sums[p, _JUNCTION_DEFERRED] += inside
        if lost or asked or flags[r, YIELDING] or inside:
            sums[p, _DEFERRED_STEPS] += 1
            flags[r, DEFERRED] = 1
            if flags[r, COMMANDED]:
                flags[r, COMMANDED] = 0
                release[releases] = r
                releases += 1
        else:
            flags[r, DEFERRED] = 0
            accel = min(max(action[a], ACTION_LOW_MPS2), ACTION_HIGH_MPS2)
            speed = max(floats[r, SPEED] + accel * step_s, 0.0)
            if flags[r, COMMANDED] and speed == floats[r, TARGET]:
                continue
            flags[r, COMMANDED] = 1
            floats[r, TARGET] = speed
            command[commands] = r
            target[commands] = speed
            commands += 1
    return commands, releases
