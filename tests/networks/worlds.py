"""Intersections made for tests, and a way to drive through their nets with SUMO itself."""

import os
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import sumo
from defusedxml import ElementTree

from izoo.contexts.movements import exits_by_turn
from izoo.contexts.spec import LEG_NAMES, Approach, GhostSpec, IntersectionSpec, Leg, SignalPlan
from izoo.networks.road import RoadNet

CROSS = (0.0, 90.0, 180.0, 270.0)


def lanes_for(count: int, turns: str) -> tuple[str, ...]:
    """Spread the available ``turns`` over ``count`` lanes, right to left."""
    if count == 1:
        return (turns,)
    middle = "s" if "s" in turns else turns[-1]
    first = "rs" if "r" in turns and "s" in turns else turns[0]
    last = "sl" if count == 2 and "s" in turns and "l" in turns else turns[-1]
    return (first, *[middle] * (count - 2), last)


def intersection(
    bearings: tuple[float, ...] = CROSS,
    lanes: int = 2,
    exit_lanes: int | None = None,
    *,
    plan: SignalPlan | None = None,
    ghosts: GhostSpec | None = None,
    right_on_red: bool = False,
    source: str = "osm",
    aadt: float = 4000.0,
    **approach: float,
) -> IntersectionSpec:
    """Return an intersection with equal legs; ``approach`` overrides fields of every :class:`Approach`."""
    count = exit_lanes or lanes
    bare = [Leg(LEG_NAMES[i], bearing, None, count, 300.0, 15.0) for i, bearing in enumerate(bearings)]
    values = {"length_m": 300.0, "speed_limit_mps": 15.0, "grade": 0.0, "aadt_per_lane": aadt, **approach}
    legs = []
    for leg in bare:
        turns = "".join(exits_by_turn(bare, leg.name))
        side = Approach(lanes=lanes_for(lanes, turns), **values)  # type: ignore[arg-type]
        legs.append(Leg(leg.name, leg.bearing_deg, side, count, 300.0, 15.0))
    return IntersectionSpec(
        "test/intersection", source, tuple(legs), plan, ghosts or GhostSpec(), right_on_red=right_on_red
    )


def with_approaches(spec: IntersectionSpec, legs: str, **changes: Any) -> IntersectionSpec:
    """Return ``spec`` with other fields of the approaches of ``legs``, such as ``"AC"``."""
    changed = (
        replace(leg, approach=replace(leg.approach, **changes)) if leg.approach and leg.name in legs else leg
        for leg in spec.legs
    )
    return replace(spec, legs=tuple(changed))


@dataclass(frozen=True)
class Drive:
    """What became of a run: vehicles that were sent and that arrived, SUMO's messages, and its output folder."""

    sent: int
    arrived: int
    warnings: list[str]
    folder: Path


def run_sumo(net: Path, folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run SUMO on ``net`` inside ``folder``."""
    command = [str(Path(sumo.SUMO_HOME, "bin", "sumo")), "-n", str(net), "--no-step-log", "true", *options]
    environment = {**os.environ, "SUMO_HOME": sumo.SUMO_HOME}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def drive_everywhere(net: Path, road: RoadNet, folder: Path, *options: str) -> Drive:
    """Send a vehicle from every source lane along every movement, one every two seconds."""
    lines, sent = [], 0
    for p in range(len(road.approaches)):
        for kind, source in road.sources[p].items():
            for q in range(len(road.exits)):
                for lane in road.source_lanes[p][kind] if road.movement_turn[p, q] >= 0 else ():
                    edges = " ".join([source, *road.incoming_edges[p], road.outgoing_edge[q]])
                    start = f'id="{sent}" depart="{2 * sent}" departLane="{lane}"'
                    lines.append(f'<vehicle {start}><route edges="{edges}"/></vehicle>')
                    sent += 1
    (folder / "all.rou.xml").write_text("\n".join(["<routes>", *lines, "</routes>"]))
    run = run_sumo(
        *(net, folder, "-r", "all.rou.xml", "--tripinfo-output", "trips.xml", "--end", "3000"),
        *("--time-to-teleport", "-1", "--step-length", "0.5", *options),
    )
    # SUMO's default driver brakes hard at a yellow now and then; that is no fault of the net.
    warnings = [line for line in run.stderr.splitlines() if "emergency braking" not in line]
    arrived = len(ElementTree.parse(folder / "trips.xml").getroot()) if (folder / "trips.xml").exists() else 0
    return Drive(sent, arrived, warnings, folder)


def saved_states(net: Path, folder: Path, signals: tuple[str, ...], end_s: int) -> dict[str, dict[float, str]]:
    """State of each signal by simulated time, as SUMO shows it."""
    events = "".join(f'<timedEvent type="SaveTLSStates" source="{name}" dest="{name}.xml"/>' for name in signals)
    (folder / "save.add.xml").write_text(f"<additional>{events}</additional>")
    run = run_sumo(net, folder, "-a", "save.add.xml", "--end", str(end_s))
    assert run.returncode == 0, run.stderr
    states = {name: ElementTree.parse(folder / f"{name}.xml").getroot() for name in signals}
    return {name: {float(each.get("time")): each.get("state") for each in found} for name, found in states.items()}
