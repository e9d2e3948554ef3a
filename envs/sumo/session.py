"""The only module that imports libsumo: starts, loads, steps and reads one simulation in this process.

Vehicle ids are used in this package only (:mod:`izoo.envs.sumo.vehicle_ids`).
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import locale
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from izoo.envs.sumo.stderr_filter import StderrFilter
from izoo.errors import IzooError
from izoo.networks.net.netconvert import SUMO_VERSION

_CHECK_ALL = 31  # speed mode: safe speed, own acceleration and deceleration limits, right of way, red lights
_INSTALL = f"pip install libsumo=={SUMO_VERSION} eclipse-sumo=={SUMO_VERSION}"

# libsumo runs one simulation per process; this session owns it.
_owner: SumoSession | None = None
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
_SPLIT = re.compile(r",|\$\{.*\}")


def import_libsumo() -> Any:
    """Import libsumo after checking that it and ``eclipse-sumo`` are installed in the same version.

    Raises:
        IzooError: one of them is missing, or their versions differ.
    """
    versions = {}
    for package in ("libsumo", "eclipse-sumo"):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            raise IzooError(f"{package} is not installed; run: {_INSTALL}") from None
    if len(set(versions.values())) != 1:
        found = " and ".join(f"{package} {version}" for package, version in versions.items())
        raise IzooError(f"{found} do not match; both must be of one version. Run: {_INSTALL}")
    import sumo

    os.environ.setdefault("SUMO_HOME", sumo.SUMO_HOME)
    import libsumo

    return libsumo


def sumo_arguments(net: Path | str, routes: Path | str, seed: int, step_s: float) -> list[str]:
    """Return the options of an episode; ``sumo`` run with them equals an uncommanded environment."""
    return [
        *("--net-file", str(net), "--route-files", str(routes)),
        *("--step-length", f"{step_s:g}", "--seed", str(seed % 2**31)),
        *("--time-to-teleport", "-1", "--default.speeddev", "0"),
        # A collision is contact of the bodies, not a gap below minGap.
        *("--collision.action", "warn", "--collision.check-junctions", "true", "--collision.mingap-factor", "0"),
        *("--no-step-log", "true", "--no-warnings", "true", "--duration-log.disable", "true"),
        *("--xml-validation", "never", "--xml-validation.net", "never", "--xml-validation.routes", "never"),
    ]


@contextlib.contextmanager
def readable_paths(*paths: Path) -> Iterator[list[Path]]:
    """Give paths that SUMO can read: it splits paths at commas, and takes ``${NAME}`` for a variable."""
    if not any(_SPLIT.search(str(path)) for path in paths):
        yield list(paths)
        return
    around = "/tmp" if _SPLIT.search(tempfile.gettempdir()) else None
    with tempfile.TemporaryDirectory(prefix="izoo-", dir=around) as folder:
        links = [Path(folder, f"{number}.xml") for number in range(len(paths))]
        for link, path in zip(links, paths, strict=True):
            link.symlink_to(path.absolute())
        yield links


def has_screen() -> bool:
    """Whether a window can be opened."""
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in _DISPLAYS)


def import_traci() -> Any:
    """Import TraCI, which controls sumo-gui in its own process.

    Raises:
        IzooError: there is no screen to open a window on.
    """
    if not has_screen():
        raise IzooError("env.gui needs a screen, and DISPLAY is not set; use render() for pictures without one.")
    import_libsumo()
    import traci

    return traci


class SumoSession:
    """A simulation; the first :meth:`load` starts SUMO, later ones re-use it.

    Args:
        gui: show it in a sumo-gui window, controlled through TraCI; otherwise libsumo runs inside this process.
    """

    def __init__(self, gui: bool = False) -> None:
        self._gui = gui
        self._running = False
        self._stderr = StderrFilter()

    def load(self, arguments: Sequence[str]) -> None:
        """Begin an episode.

        Raises:
            IzooError: SUMO cannot load the files or read their paths, or another environment of this process uses
                libsumo.
        """
        global _owner
        _check_encoding(arguments)
        api = import_traci() if self._gui else import_libsumo()
        if _owner is not None and _owner is not self:
            raise IzooError(
                "libsumo holds one simulation per process, and another environment of this process is using it; "
                "close() that one first, or run each in a process of its own: izoo.envs.SumoParallelEnv, or "
                "gymnasium.make_vec(..., vectorization_mode='async'), or a view without in_process=True."
            )
        if locale.localeconv()["decimal_point"] != "." and not self._gui:
            raise IzooError(
                "numbers have a decimal comma in this process, and SUMO, which runs inside it, needs a point; call "
                "locale.setlocale(locale.LC_NUMERIC, 'C')."
            )
        try:
            if self._running:
                api.load(list(arguments))
            else:
                api.start([*self._program(), *arguments])
        except Exception as error:
            self._running = False
            _owner = None
            raise IzooError(f"SUMO could not load the simulation: {_error_messages(arguments) or error}") from error
        _owner, self._running, self._api = self, True, api
        self._stderr.dropped = 0
        self._bind(api)

    def _program(self) -> list[str]:
        if not self._gui:
            return ["sumo"]
        return [str(Path(os.environ["SUMO_HOME"]) / "bin" / "sumo-gui"), "--start", "true", "--quit-on-end", "true"]

    def _bind(self, api: Any) -> None:
        """Look up the functions of the inner loop once; the flat ones save a Python call per value."""
        flat, vehicle = getattr(api, "_libsumo", None), api.vehicle
        self._lane = getattr(flat, "vehicle_getLaneID", vehicle.getLaneID)
        self._position = getattr(flat, "vehicle_getLanePosition", vehicle.getLanePosition)
        self._speed = getattr(flat, "vehicle_getSpeed", vehicle.getSpeed)
        self._signals = getattr(flat, "vehicle_getSignals", vehicle.getSignals)
        self._set_speed = getattr(flat, "vehicle_setSpeed", vehicle.setSpeed)
        self._acceleration = vehicle.getAcceleration
        self._free_speed = vehicle.getSpeedWithoutTraCI
        self._change_lane = vehicle.changeLaneRelative
        self._on_edge = api.edge.getLastStepVehicleIDs
        self._count_on_edge = getattr(flat, "edge_getLastStepVehicleNumber", api.edge.getLastStepVehicleNumber)
        self._simulation = api.simulation
        self._departed = getattr(flat, "simulation_getDepartedIDList", api.simulation.getDepartedIDList)
        self._vehicle = vehicle
        self._advance = api.simulationStep

    def advance(self) -> None:
        """Simulate one step."""
        self._advance()

    def advance_departing(self) -> None:
        """Simulate a step in which vehicles are due to depart, and count those that SUMO drops."""
        self._stderr.call(self._advance)

    @property
    def dropped(self) -> int:
        """Number of vehicles dropped in this episode because they could not enter the network safely."""
        return self._stderr.dropped

    @property
    def time_s(self) -> float:
        """Simulated time."""
        return float(self._simulation.getTime())

    def is_empty(self) -> bool:
        """Whether no vehicle is in the network, waits to enter it, or is yet to depart."""
        return bool(self._simulation.getMinExpectedNumber() == 0)

    def arrived(self) -> Sequence[str]:
        """Vehicles that reached the end of their route in the last step."""
        return self._simulation.getArrivedIDList()

    def departed(self) -> Sequence[str]:
        """Vehicles that entered the network in the last step."""
        return self._departed()

    def driving(self) -> Sequence[str]:
        """All vehicles in the network."""
        return self._vehicle.getIDList()

    def on_edge(self, edge: str) -> Sequence[str]:
        """Vehicles on an edge."""
        return self._on_edge(edge)

    def count_on(self, edges: Sequence[str]) -> int:
        """Number of vehicles on these edges together."""
        return sum(map(self._count_on_edge, edges))

    def read(
        self, names: Sequence[str], lane_numbers: dict[str, int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return region lane, lane position (m), speed (m/s) and signal bits of the named vehicles, each ``[n]``."""
        n = len(names)
        return (
            np.fromiter(map(lane_numbers.__getitem__, map(self._lane, names)), np.int64, n),
            np.fromiter(map(self._position, names), np.float64, n),
            np.fromiter(map(self._speed, names), np.float64, n),
            np.fromiter(map(self._signals, names), np.int64, n),
        )

    def acceleration(self, name: str) -> float:
        """Acceleration of the last step in m/s^2."""
        return float(self._acceleration(name))

    def free_speed(self, name: str) -> float:
        """Speed in m/s that SUMO would have chosen in the last step without a command."""
        return float(self._free_speed(name))

    def command_speeds(self, names: Sequence[str], speeds_mps: Sequence[float]) -> None:
        """Command speeds from the next step on; SUMO's safety checks stay on. A negative speed ends the command."""
        set_speed = self._set_speed
        for name, speed in zip(names, speeds_mps, strict=True):
            set_speed(name, speed)

    def limit_speeds(self, names: Sequence[str], speeds_mps: Sequence[float]) -> None:
        """Set the maximum speed of vehicles permanently: their own car-following keeps to it."""
        for name, speed in zip(names, speeds_mps, strict=True):
            self._vehicle.setMaxSpeed(name, speed)

    def restrict_lane_changes(self, name: str) -> None:
        """Allow SUMO to change this vehicle's lane only where its route needs it; commands obey safety gaps."""
        self._vehicle.setLaneChangeMode(name, 0b001000000001)

    def restore_lane_changes(self, name: str) -> None:
        """Restore SUMO's default lane changing for this vehicle."""
        self._vehicle.setLaneChangeMode(name, 0b011001010101)

    def change_lane(self, name: str, steps_left: int, duration_s: float) -> None:
        """Request a change by one lane (positive: to the left)."""
        self._change_lane(name, steps_left, duration_s)

    def check_all_speeds(self, name: str) -> None:
        """Keep all speed checks on for a vehicle that will be commanded."""
        self._vehicle.setSpeedMode(name, _CHECK_ALL)

    def collisions(self) -> list[tuple[str, str]]:
        """Return ``(rear vehicle, other vehicle)`` of the collisions of the last step."""
        return [(c.collider, c.victim) for c in self._simulation.getCollisions()]

    def waiting(self) -> Sequence[str]:
        """Vehicles that wait to enter the network."""
        return self._simulation.getPendingVehicles()

    def close(self) -> None:
        """End the simulation and release libsumo."""
        global _owner
        if self._running:
            self._api.close()
            self._running = False
        if _owner is self:
            _owner = None


def _check_encoding(arguments: Sequence[str]) -> None:
    """Refuse paths that the locale of this process cannot encode: SUMO takes text."""
    for argument in arguments:
        try:
            argument.encode()
        except UnicodeEncodeError:
            raise IzooError(
                f"the locale of this process cannot encode the path {argument!a}; set IZOO_CACHE_DIR and TMPDIR to "
                "folders with plain names, or use a locale of UTF-8 (LC_ALL=C.UTF-8)."
            ) from None


def _error_messages(arguments: Sequence[str]) -> str:
    """Return SUMO's errors for ``arguments`` by running ``sumo``, since those of libsumo cannot be caught."""
    program = Path(os.environ["SUMO_HOME"]) / "bin" / "sumo"
    try:
        run = subprocess.run([str(program), *arguments, "--end", "0"], capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return " ".join(line.strip() for line in run.stderr.splitlines() if line.startswith("Error:"))
