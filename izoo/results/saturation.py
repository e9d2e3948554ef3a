"""Volume over capacity of an approach, from its demand and its signal plan."""

from __future__ import annotations

import math

import numpy as np

from izoo.contexts.context import Context
from izoo.networks.road import RoadNet
from izoo.networks.turning import exit_shares

SATURATION_FLOW_VPH_PER_LANE = 1800.0
"""Vehicles per hour of green and lane: one every two seconds (HCM: 1,900 under ideal conditions)."""


def volume_over_capacity(context: Context, road: RoadNet, approach: int) -> float:
    """Return demand over capacity of one approach; above 1 its queue grows without end.

    The larger of the busiest movement's ratio, over the lanes that lead to it, and the ratio of the approach as a
    whole, whose lanes must find room for all movements in their greens. Permissive greens count in full and
    movements that may turn on red count as free, so the true ratio is not below this one. 0 without demand.
    """
    name = road.approaches[approach]
    volume = context.flow_vph_per_lane(name) * float(road.main_lane_count[approach])
    if volume == 0.0:
        return 0.0
    links = road.movement_links[approach]
    shares = exit_shares(context.intersection.leg(name).approach, road.exits, road.movement_turn[approach], links)
    green_share = road.clock.green_s[approach] / road.clock.cycle_s
    free_on_red = road.clock.legal_on_red[approach].any(axis=-1)
    lanes_needed, busiest = 0.0, 0.0
    for exit_leg in np.flatnonzero(shares > 0):
        if green_share[exit_leg] <= 0.0:
            if free_on_red[exit_leg]:
                continue
            return math.inf
        lanes = volume * shares[exit_leg] / (SATURATION_FLOW_VPH_PER_LANE * green_share[exit_leg])
        lanes_needed += lanes
        busiest = max(busiest, lanes / max(float(links[exit_leg]), 1.0))
    return float(max(busiest, lanes_needed / float(road.lane_count[approach])))
