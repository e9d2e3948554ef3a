"""Small signalised crossroads in the convention of the measured nets, and vehicles that meet there."""

import os
import re
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import sumo

from izoo.benchmarks.fidelity.single_vehicle import Case, Commands, Trace, first_departure, play_sumo, play_twin
from izoo.envs.twin.net.reader import read_twin_world
from izoo.networks.road import read_road
from izoo.traffic.sampling import PAPER_CV, Traffic

_LEGS = {"A": (0.0, 1.0), "B": (1.0, 0.0), "C": (0.0, -1.0), "D": (-1.0, 0.0)}
_OPTIONS = ("--no-turnarounds", "true", "--offset.disable-normalization", "true", "--precision", "6")


def build_crossroads(
    folder: Path,
    phases: list[tuple[float, str]],
    lanes: int = 1,
    length_m: float = 110.0,
    limit_mps: float = 13.89,
    options: tuple[str, ...] = (),
) -> Path:
    """Build four equal legs around the signal ``TL`` with every turn from the lanes that ``netconvert`` chooses.

    Args:
        phases: durations (s) and states of the signal; links in ``netconvert``'s order: legs A to D, right turns first.
    """
    folder.mkdir(parents=True, exist_ok=True)
    nodes = ['<node id="TL" x="0" y="0" type="traffic_light"/>']
    edges = []
    for leg, (x, y) in _LEGS.items():
        nodes += [
            f'<node id="{leg}" x="{x * length_m}" y="{y * length_m}" type="priority"/>',
            f'<node id="{leg}B" x="{x * (length_m + 60.0)}" y="{y * (length_m + 60.0)}"/>',
        ]
        for name, start, end in ((f"{leg}B2{leg}", f"{leg}B", leg), (f"{leg}2TL", leg, "TL"), (f"TL2{leg}", "TL", leg)):
            edges.append(f'<edge id="{name}" from="{start}" to="{end}" numLanes="{lanes}" speed="{limit_mps}"/>')
    (folder / "n.nod.xml").write_text(f"<nodes>{''.join(nodes)}</nodes>")
    (folder / "n.edg.xml").write_text(f"<edges>{''.join(edges)}</edges>")
    subprocess.run(
        [
            str(Path(sumo.SUMO_HOME, "bin", "netconvert")),
            *("-n", str(folder / "n.nod.xml"), "-e", str(folder / "n.edg.xml"), "-o", str(folder / "plain.net.xml")),
            *_OPTIONS,
            *options,
        ],
        check=True,
        capture_output=True,
        env={**os.environ, "SUMO_HOME": sumo.SUMO_HOME},
    )
    body = "".join(f'<phase duration="{duration:g}" state="{state}"/>' for duration, state in phases)
    text = (folder / "plain.net.xml").read_text()
    text = re.sub(
        r'(<tlLogic id="TL".*?>).*?(</tlLogic>)', lambda m: m.group(1) + body + m.group(2), text, flags=re.DOTALL
    )
    path = folder / "net.net.xml"
    path.write_text(text)
    return path


def meeting(path: Path, vehicles: list[dict[str, Any]]) -> Case:
    """Return the case of vehicles with ``depart`` (s), ``way`` such as ``"AC"``, ``lane``, and driver's parameters."""
    road = read_road(path)
    vehicles = sorted(vehicles, key=lambda vehicle: vehicle["depart"])
    count = len(vehicles)

    def column(name: str, default: float) -> np.ndarray:
        return np.array([float(vehicle.get(name, default)) for vehicle in vehicles])

    traffic = Traffic(
        depart_s=column("depart", 0.0),
        approach=np.array([road.approaches.index(vehicle["way"][0]) for vehicle in vehicles]),
        exit=np.array([road.exits.index(vehicle["way"][1]) for vehicle in vehicles]),
        source=np.zeros(count, np.int64),
        depart_lane=column("lane", 0).astype(np.int64),
        is_cv=np.zeros(count, bool),
        source_type=np.full(count, 21),
        moves_class=np.zeros(count, np.int64),
        **{name: column(name, value) for name, value in PAPER_CV.items()},
        cv_vehicle="human",
    )
    return Case(read_twin_world(road, path), path, traffic, 1)


def assert_same(case: Case, steps: int, tolerance: float = 1e-3, commands: Commands | None = None) -> Trace:
    """Assert that every vehicle is in the same place in every step on both simulators; return SUMO's trace."""
    sumo = play_sumo(case, steps, commands)
    departure = first_departure(case, sumo, play_twin(case, steps, commands), tolerance)
    assert departure is None, str(departure)
    return sumo


def lane_names(case: Case, trace: Trace) -> np.ndarray:
    """Return the lane of every vehicle ``[T, N]`` by name, empty where it is not on the road."""
    return np.array([*case.world.lane_ids, ""])[trace.lane]
