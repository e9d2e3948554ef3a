"""Best lanes against ``vehicle.getBestLanes`` of the installed SUMO."""

import contextlib
from pathlib import Path

import numpy as np

from izoo.contexts.context import Context
from izoo.contexts.procedural import procedural_context
from izoo.contexts.source import ContextList
from izoo.envs.sumo.session import import_libsumo, sumo_arguments
from izoo.envs.twin.driving.traffic_lights import is_major
from izoo.envs.twin.net.reader import read_twin_world, twin_traffic
from izoo.envs.twin.runtime.layout import TwinNet
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from izoo.traffic.sampling import sample_traffic, write_routes

SEED, STEPS = 3, 240


def continuation(net: TwinNet, variant: int, lane: int) -> list[int]:
    """Lanes on the best way from ``lane``, inside lanes left out."""
    lanes = [] if net.lanes["inside"][lane] else [lane]
    while (link := net.best["link"][variant, lane]) >= 0:
        lane = int(net.links["next_lane"][link])
        if not net.lanes["inside"][lane]:
            lanes.append(lane)
    return lanes


def assert_best_lanes_equal(context: Context, folder: Path) -> int:
    """Compare all that SUMO reports in an episode with one of the route's variants; return how many were compared."""
    with contextlib.closing(import_libsumo()) as libsumo:
        path = build_net(context.intersection)
        road = read_road(path)
        world = read_twin_world(road, path)
        net, row = world.net, {name: k for k, name in enumerate(world.lane_ids)}
        traffic = sample_traffic(context, road, SEED, STEPS * 0.5)
        route = twin_traffic(traffic, road, net).drivers["route"]
        write_routes(traffic, road, folder / "traffic.rou.xml")
        libsumo.start(["sumo", *sumo_arguments(path, folder / "traffic.rou.xml", SEED, 0.5)])
        compared = 0
        for step in range(STEPS):
            libsumo.simulationStep()
            for name in libsumo.vehicle.getIDList() if step % 8 == 0 else ():
                lane = row[libsumo.vehicle.getLaneID(name)]
                if net.lanes["inside"][lane]:
                    continue
                reported = libsumo.vehicle.getBestLanes(name)
                first, count = net.routes[["first_variant", "variants"]][route[int(name)]]
                variants = range(first, first + count)
                lanes = [row[best[0]] for best in reported]
                found = [
                    np.allclose(net.best["length"][x, lanes], [best[1] for best in reported])
                    and net.best["offset"][x, lanes].tolist() == [best[3] for best in reported]
                    and [continuation(net, x, k) for k in lanes] == [[row[k] for k in best[5]] for best in reported]
                    for x in variants
                ]
                assert any(found), f"{context.name}: vehicle {name} at step {step}: {reported}"
                compared += 1
    return compared


def test_best_lanes_equal_sumos(tmp_path: Path) -> None:
    world = procedural_context(lane_count=3, phase_count=2, approach="all", inflow_vph_per_lane=600.0)
    assert assert_best_lanes_equal(world, tmp_path) > 100


def test_best_lanes_of_measured_intersections_equal_sumos(dataset: ContextList, tmp_path: Path) -> None:
    """Pockets, and several lanes to one exit of which some yield (number 110)."""
    contexts = {context.intersection.name.rsplit("/", 1)[-1]: context for context in dataset}
    for number in ("110", "106"):
        assert assert_best_lanes_equal(contexts[number].replace(approach=None), tmp_path) > 100


def test_only_capital_letters_have_priority() -> None:
    """``=``, between equal roads, has none, though it comes before them."""
    assert [letter for letter in "GMYgmyrsw=-" if is_major(ord(letter))] == ["G", "M", "Y"]
