"""What decides an evaluated number: versions, settings of the environment, and the package's own files."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import platform
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import izoo
from izoo.envs.config import EnvConfig

SIMULATED_BY = {
    "izoo.contexts": None,
    "izoo.networks": None,
    "izoo.traffic": None,
    "izoo.emissions": None,
    "izoo.envs": None,
    "izoo.metrics": ("definitions.py",),
    "izoo.evaluation": ("playing.py", "table.py", "saturation.py"),
}
"""Packages, folders inside included, or the files of a package, that decide what a row holds."""
DECISIVE = ("izoo", "sumo", "neuralmoves", "code")
"""Versions that an episode depends on."""
INDIFFERENT = ("emit", "recycle_episodes", "watchdog_s", "gui")
"""Settings of an environment that change no number."""


@functools.cache
def code_digest(drivers: bool = False) -> str:
    """SHA-256 over the files of :data:`SIMULATED_BY`, so that numbers of different versions are never mixed.

    Args:
        drivers: over the algorithms and scripted drivers instead.
    """
    return digest_of({"izoo.algos": None} if drivers else SIMULATED_BY)


def digest_of(packages: Mapping[str, tuple[str, ...] | None]) -> str:
    """Return SHA-256 over the files of packages, all of them or, of each package, those that are named."""
    digest = hashlib.sha256()
    for package, names in packages.items():
        folder = Path(str(resources.files(package)))
        for path in sorted(path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts):
            name = path.relative_to(folder).as_posix()
            if names is None or name in names:
                digest.update(f"{package}/{name}\n".encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()


def settings(config: EnvConfig, simulator: str = "sumo") -> dict[str, Any]:
    """Return what, besides context, seed and policy, decides an episode; plain values for JSON."""
    env = {key: value for key, value in dataclasses.asdict(config).items() if key not in INDIFFERENT}
    found = versions()
    decisive = {name: found[name] for name in DECISIVE}
    return json.loads(json.dumps({"simulator": simulator, "env": env, "versions": decisive}))


def versions() -> dict[str, str]:
    """Return the versions that decide trained policies and their numbers; ``code`` is :func:`code_digest`."""
    packages = {"sumo": "libsumo", "torch": "torch", "torchrl": "torchrl", "neuralmoves": "neuralmoves"}
    found = {name: importlib.metadata.version(package) for name, package in packages.items()}
    return {"izoo": izoo.__version__, "python": platform.python_version(), **found, "code": code_digest()}
