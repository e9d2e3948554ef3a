"""Episodes that do not depend on a policy (human and uncommanded driving), kept on disk and computed once.

An entry's key covers everything that decides the episode: the context's content, the seed, and what
:func:`izoo.evaluation.provenance.settings` names.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from pathlib import Path
from typing import Any

from izoo.contexts.context import Context
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError
from izoo.evaluation.provenance import settings
from izoo.evaluation.table import read_journal
from izoo.files import cache_root, write_text


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
        simulator: what plays them.
    """

    def __init__(self, folder: Path, config: EnvConfig, simulator: str = "sumo") -> None:
        self.folder = folder
        self._settings = json.dumps(settings(config, simulator), sort_keys=True)

    def get(self, driver: str, context: Context, seed: int) -> list[dict[str, Any]] | None:
        """Return the rows of an episode, or ``None`` where it has not been run."""
        try:
            return read_journal(self._path(driver, context, seed)) or None
        except IzooError:
            return None

    def put(self, driver: str, context: Context, seed: int, rows: list[dict[str, Any]]) -> None:
        """Keep the rows of an episode; a folder that cannot be written is no error, the episode is only run again."""
        path = self._path(driver, context, seed)
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, json.dumps(rows) + "\n", durable=False)

    def _path(self, driver: str, context: Context, seed: int) -> Path:
        key = f"{driver}\n{context.content_hash}\n{seed}\n{self._settings}"
        digest = hashlib.sha256(key.encode()).hexdigest()
        return self.folder / digest[:2] / f"{digest}.json"
