"""The only module that imports libsumo: starts, loads, steps and reads one simulation in this process.

Vehicle ids are used in this package only.
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

    Attributes:
        advance: simulates one step.
        arrived, departed: vehicles that ended their route, and that entered the network, in the last step.
        driving, waiting: all vehicles in the network, and those that wait to enter it.
        on_edge: vehicles on an edge.
        acceleration, free_speed: of a vehicle in the last step in m/s^2; the speed in m/s that it would have chosen
            without a command.
        change_lane: requests a change by one lane (positive: to the left) of a vehicle, for some seconds.
        limit_speed: sets a vehicle's maximum speed permanently: its own car-following keeps to it.
        set_speed_mode, set_lane_change_mode: what SUMO checks of a vehicle's commands, and does by itself.
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
        flat, vehicle, simulation = getattr(api, "_libsumo", None), api.vehicle, api.simulation
        self._lane = getattr(flat, "vehicle_getLaneID", vehicle.getLaneID)
        self._position = getattr(flat, "vehicle_getLanePosition", vehicle.getLanePosition)
        self._speed = getattr(flat, "vehicle_getSpeed", vehicle.getSpeed)
        self._signals = getattr(flat, "vehicle_getSignals", vehicle.getSignals)
        self._set_speed = getattr(flat, "vehicle_setSpeed", vehicle.setSpeed)
        self._count_on_edge = getattr(flat, "edge_getLastStepVehicleNumber", api.edge.getLastStepVehicleNumber)
        self._simulation = simulation
        self.advance = api.simulationStep
        self.arrived = simulation.getArrivedIDList
        self.departed = getattr(flat, "simulation_getDepartedIDList", simulation.getDepartedIDList)
        self.driving, self.waiting = vehicle.getIDList, simulation.getPendingVehicles
        self.on_edge = api.edge.getLastStepVehicleIDs
        self.acceleration, self.free_speed = vehicle.getAcceleration, vehicle.getSpeedWithoutTraCI
        self.change_lane, self.limit_speed = vehicle.changeLaneRelative, vehicle.setMaxSpeed
        self.set_speed_mode, self.set_lane_change_mode = vehicle.setSpeedMode, vehicle.setLaneChangeMode

    def advance_departing(self) -> None:
        """Simulate a step in which vehicles are due to depart, and count those that SUMO drops."""
        self._stderr.call(self.advance)

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

    def command_speeds(self, names: Sequence[str], speeds_mps: Sequence[float]) -> None:
        """Command speeds from the next step on; SUMO's safety checks stay on. A negative speed ends the command."""
        set_speed = self._set_speed
        for name, speed in zip(names, speeds_mps, strict=True):
            set_speed(name, speed)

    def collisions(self) -> list[tuple[str, str]]:
        """Return ``(rear vehicle, other vehicle)`` of the collisions of the last step."""
        return [(c.collider, c.victim) for c in self._simulation.getCollisions()]

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
