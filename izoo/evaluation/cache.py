"""Episodes that do not depend on a policy (human and uncommanded driving), kept on disk and computed once.

An entry's key covers everything that decides the episode: the context's content, the seed, the environment's
settings, the versions of SUMO, of the surrogates and of the package, and the package's own files below the policy.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import json
from importlib import resources
from pathlib import Path
from typing import Any

import izoo
from izoo.contexts.context import Context
from izoo.envs.config import EnvConfig
from izoo.files import cache_root, write_text

SIMULATED_BY = {
    "izoo.contexts": None,
    "izoo.networks": None,
    "izoo.traffic": None,
    "izoo.emissions": None,
    "izoo.envs": None,
    "izoo.metrics": ("definitions.py",),
    "izoo.evaluation": ("episode.py", "table.py", "saturation.py"),
}
"""Packages, or the files of a package, that decide what a row holds."""
INDIFFERENT = ("emit", "recycle_episodes", "watchdog_s", "gui")
"""Settings of an environment that change no number."""


@functools.cache
def code_digest(drivers: bool = False) -> str:
    """SHA-256 over the files of :data:`SIMULATED_BY`, so that a changed simulator never meets old numbers.

    Args:
        drivers: over the algorithms and scripted drivers instead.
    """
    digest = hashlib.sha256()
    for package, names in ({"izoo.algos": None} if drivers else SIMULATED_BY).items():
        folder = Path(str(resources.files(package)))
        for path in sorted(folder.rglob("*")):
            if path.is_file() and (names is None or path.name in names) and "__pycache__" not in path.parts:
                digest.update(f"{package}/{path.relative_to(folder).as_posix()}\n".encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()


def settings(config: EnvConfig) -> dict[str, Any]:
    """Return what, besides context, seed and policy, decides an episode; plain values for JSON."""
    env = {key: value for key, value in dataclasses.asdict(config).items() if key not in INDIFFERENT}
    packages = {"sumo": "libsumo", "neuralmoves": "neuralmoves"}
    versions = {name: importlib.metadata.version(package) for name, package in packages.items()}
    versions |= {"izoo": izoo.__version__, "code": code_digest()}
    return json.loads(json.dumps({"env": env, "versions": versions}))


def baseline_context(context: Context) -> Context:
    """Return the context of human driving: without CVs, so that what only concerns CVs is set to one value."""
    return context.replace(adoption=0.0, engine="combustion", cv_vehicle="paper")


def default_folder() -> Path:
    """Return the folder ``baselines`` of ``$IZOO_CACHE_DIR``, or else of the user's cache."""
    return cache_root() / "baselines"


class EpisodeCache:
    """Rows of policy-free episodes by (driver, context, seed, settings).

    Args:
        folder: where entries lie; a damaged entry counts as absent.
        config: settings of the environment.
    """

    def __init__(self, folder: Path, config: EnvConfig) -> None:
        self.folder = folder
        self._settings = json.dumps(settings(config), sort_keys=True)

    def get(self, driver: str, context: Context, seed: int) -> list[dict[str, Any]] | None:
        """Return the rows of an episode, or ``None`` where it has not been run."""
        try:
            rows = json.loads(self._path(driver, context, seed).read_text())
        except (OSError, ValueError):
            return None
        return rows if isinstance(rows, list) else None

    def put(self, driver: str, context: Context, seed: int, rows: list[dict[str, Any]]) -> None:
        """Keep the rows of an episode; a folder that cannot be written is no error, the episode is only run again."""
        path = self._path(driver, context, seed)
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, json.dumps(rows), durable=False)

    def _path(self, driver: str, context: Context, seed: int) -> Path:
        key = f"{driver}\n{context.content_hash}\n{seed}\n{self._settings}"
        digest = hashlib.sha256(key.encode()).hexdigest()
        return self.folder / digest[:2] / f"{digest}.json"
