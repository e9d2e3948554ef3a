"""Episodes that do not depend on a policy (human and uncommanded driving), kept on disk and played once."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from izoo.contexts.context import Context
from izoo.envs import simulator_of
from izoo.envs.model_version import MODEL_VERSION
from izoo.files import cache_root, replacing
from izoo.results.playing import Measured, Setup
from izoo.results.schema import COLUMNS
from izoo.results.store import settings, versions

UNSEEN = ("observed", "neighbours", "sensor_range_m")
"""Settings that do not concern a driver that commands nothing."""


def baseline_context(context: Context) -> Context:
    """Return the context of human driving: without CVs, so that what only concerns CVs is set to one value."""
    return context.replace(adoption=0.0, engine="combustion", cv_vehicle="paper")


class EpisodeCache:
    """What baseline episodes came to, by driver, context, seed, settings and versions of the model and of SUMO.

    Args:
        folder: where entries lie; one that cannot be read counts as absent. ``None``: ``baselines`` of
            ``$IZOO_CACHE_DIR``, or else of the user's cache.
        setup: what plays the episodes.
    """

    def __init__(self, folder: Path | str | None, setup: Setup) -> None:
        self.folder = cache_root() / "baselines" if folder is None else Path(folder)
        env = {name: value for name, value in settings(setup.config).items() if name not in UNSEEN}
        surrogate = setup.surrogate if simulator_of(setup.simulator).batched else ""
        known = [env, setup.simulator, surrogate, MODEL_VERSION, versions()["sumo"], COLUMNS]
        self._known = json.dumps(known, sort_keys=True)

    def get(self, driver: str, context: Context, seed: int, record: Sequence[str] = ()) -> Measured | None:
        """Return what an episode came to, or ``None`` where it has not been played, or ``record`` was not kept."""
        try:
            with np.load(io.BytesIO(self._path(driver, context, seed).read_bytes()), allow_pickle=False) as file:
                rows = json.loads(bytes(file["rows"]))
                return Measured(rows, {name: file[name] for name in record})
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
            return None

    def put(self, driver: str, context: Context, seed: int, found: Measured) -> None:
        """Keep an episode; a folder that cannot be written is no error, the episode is only played again."""
        path = self._path(driver, context, seed)
        content: dict[str, Any] = {"rows": np.frombuffer(json.dumps(found.rows).encode(), np.uint8), **found.series}
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path, durable=False) as partial, partial.open("wb") as file:
                np.savez(file, **content)

    def _path(self, driver: str, context: Context, seed: int) -> Path:
        key = f"{driver}\n{context.content_hash}\n{seed}\n{self._known}"
        digest = hashlib.sha256(key.encode()).hexdigest()
        return self.folder / digest[:2] / f"{digest}.npz"
