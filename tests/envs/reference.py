"""What the ``sumo`` program makes of the files of an episode."""

import os
import subprocess
from collections import defaultdict
from pathlib import Path
from typing import Any

import sumo
from defusedxml import ElementTree

from izoo.contexts.context import Context
from izoo.envs import EnvConfig
from izoo.envs.sumo.session import sumo_arguments
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from izoo.traffic.sampling import sample_traffic, write_routes

Steps = dict[float, dict[int, tuple[str, float, float]]]


def run_sumo(context: Context, seed: int, folder: Path, config: EnvConfig) -> Steps:
    """Return ``{time after the step: {vehicle number: (lane, position, speed)}}`` of the ``sumo`` program."""
    steps: Steps = defaultdict(dict)
    for step in run_fcd(context, seed, folder, config):
        for vehicle in step:
            number, lane = int(vehicle.get("id")), vehicle.get("lane")
            # FCD names the begin of the step after which it writes.
            time_s = float(step.get("time")) + config.step_s
            steps[time_s][number] = (lane, float(vehicle.get("pos")), float(vehicle.get("speed")))
    return steps


def run_fcd(context: Context, seed: int, folder: Path, config: EnvConfig) -> Any:
    """Return the floating car data that the ``sumo`` program writes of an episode, drain included: an XML element."""
    net = build_net(context.intersection)
    road = read_road(net)
    routes, output = folder / "traffic.rou.xml", folder / "fcd.xml"
    write_routes(sample_traffic(context, road, seed, config.horizon_s), road, routes)
    program = Path(sumo.SUMO_HOME) / "bin" / ("sumo.exe" if os.name == "nt" else "sumo")
    subprocess.run(
        [
            *(str(program), *sumo_arguments(net, routes, seed, config.step_s)),
            *("--end", str(config.horizon_s + config.drain_s), "--fcd-output", str(output), "--precision", "17"),
        ],
        check=True,
        timeout=120,
    )
    return ElementTree.parse(output).getroot()
