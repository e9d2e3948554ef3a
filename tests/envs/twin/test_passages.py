"""Vehicles that pass the signal in a whole episode, by turn and by what the signal shows, against SUMO."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from izoo.benchmarks.fidelity.single_vehicle import Case, Trace, play_sumo, play_twin
from izoo.contexts.procedural import procedural_context
from izoo.envs.twin.net.reader import twin_traffic
from izoo.envs.twin.runtime.layout import LANE_EDGE, LANE_INSIDE, LINK_DIRECTION, LINK_PROGRAM, ROUTE
from izoo.envs.twin.runtime.simulation import TwinEpisode
from izoo.networks.road import read_road

pytestmark = pytest.mark.slow
HORIZON_S = 600.0
STEPS = 1200
Passages = Counter[tuple[str, str]]
"""How many passed by ``(turn, letter)``: ``("l", "g")`` are permissive lefts, ``("r", "s")`` rights on red."""


def letters_shown(case: Case) -> np.ndarray:
    """Return ``[T, K]`` uint8, what every link shows in every step; traffic does not change it."""
    net = case.world.net
    episode = TwinEpisode(net, twin_traffic(case.traffic, read_road(case.net_path), net), case.step_ms)
    shown = np.zeros((STEPS, len(net.link_ints)), np.uint8)
    for t in range(STEPS):
        episode.step()
        shown[t] = episode.state.link_letter
    return shown


def passages(case: Case, trace: Trace, shown: np.ndarray) -> Passages:
    """Count the vehicles that leave a lane by a link of the main signal."""
    net = case.world.net
    routes = twin_traffic(case.traffic, read_road(case.net_path), net).ints[:, ROUTE]
    main = case.world.program_ids.index("TL")
    found: Passages = Counter()
    before, after = trace.lane[:-1], trace.lane[1:]
    edges = net.lane_ints[:, LANE_EDGE]
    left = (before >= 0) & (after >= 0) & (edges[before] != edges[after]) & (net.lane_ints[before, LANE_INSIDE] == 0)
    for t, v in np.argwhere(left).tolist():
        link = int(net.route_link[routes[v], before[t, v]])
        if link >= 0 and net.link_ints[link, LINK_PROGRAM] == main:
            found[chr(net.link_ints[link, LINK_DIRECTION]), chr(shown[t + 1, link])] += 1
    return found


@pytest.mark.parametrize("seed", range(3))
def test_single_lane_crossings_pass_exactly_as_in_sumo(seed: int) -> None:
    context = procedural_context(lane_count=1, phase_count=2, inflow_vph_per_lane=350.0, approach="A")
    case = Case.of(context.replace(approach=None), seed, HORIZON_S)
    shown = letters_shown(case)
    theirs, ours = (passages(case, play(case, STEPS), shown) for play in (play_sumo, play_twin))
    assert sum(theirs.values()) > 50
    assert ours == theirs
