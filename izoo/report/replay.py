"""Replays: the best and the worst approach of a policy, played again beside the baseline, and kept in the folder."""

from __future__ import annotations

import contextlib
import dataclasses
import gzip
import hashlib
import json
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from tensordict import TensorDictBase

from izoo import files, zoo
from izoo.conf.mapping import from_mapping
from izoo.contexts.context import Context
from izoo.envs.config import EnvConfig
from izoo.envs.env import EcoDrivingEnv
from izoo.errors import IzooError
from izoo.evaluation.aggregates import TASK
from izoo.evaluation.baselines import baseline_context
from izoo.evaluation.playing import run_episode
from izoo.evaluation.policies import HUMAN, POLICY_FREE, Candidate, as_candidate
from izoo.evaluation.provenance import code_digest
from izoo.evaluation.sources import read_sources
from izoo.evaluation.table import MANIFEST_FILE
from izoo.reporting.material import Evaluated
from izoo.reporting.recording import Recorder, geometry
from izoo.reporting.scored import Scored
from izoo.training import checkpoint, runs

FOLDER = "replays"
FORMAT = 3
COMPARED = ("crossed", "emission_g", "travel_time_s")
"""Metrics by which a replay is recognised as the episode that was evaluated."""


@dataclass(frozen=True)
class Scene:
    """An approach to replay.

    Attributes:
        policy: its name in the table.
        which: ``best`` or ``worst``.
        context, approach: the names.
        context_hash, seed: the episode.
        benefit: without gate, over all seeds of the evaluation.
        run: whose evaluation it is.
    """

    policy: str
    which: str
    context: str
    approach: str
    context_hash: str
    seed: int
    benefit: float
    run: Evaluated


def scenes(scored: Scored) -> list[Scene]:
    """Return the approaches with the highest and the lowest benefit before gating, in the best training seed.

    Saturated approaches are passed over where two others are left. Of the evaluation's seeds the one is taken whose
    own benefit is nearest to the approach's.
    """
    table, run = scored.tables[scored.best], scored.entry.runs[scored.best]
    counted = table[(table["left_out"] == "") & table["emission_policy_g"].notna()]
    calm = counted[~counted["saturated"]]
    counted = (calm if len(calm) > 1 else counted).sort_values(["benefit_ungated", "context"], kind="stable")
    if counted.empty:
        return []
    found = []
    picked = [("best", counted.iloc[-1])] + ([("worst", counted.iloc[0])] if len(counted) > 1 else [])
    for which, row in picked:
        seed = _typical_seed(run.table, scored.entry.policy, row)
        names = (scored.entry.policy, which, row["context"], row["approach"], row["context_hash"])
        found.append(Scene(*names, seed, float(row["benefit_ungated"]), run))
    return found


def _typical_seed(table: pd.DataFrame, policy: str, row: Any) -> int:
    mine = table[(table[TASK[0]] == row[TASK[0]]) & (table[TASK[1]] == row[TASK[1]])]
    grams = {
        name: (rows["emission_g"] / rows["crossed"].where(rows["crossed"] > 0)).set_axis(rows["seed"])
        for name, rows in mine.groupby("policy")
    }
    distance = (1.0 - grams[policy] / grams[HUMAN] - row["benefit_ungated"]).abs().dropna()
    return int(distance.idxmin() if len(distance) else mine["seed"].iloc[0])


class Player:
    """Plays episodes of results again; one simulator serves all.

    Args:
        imports: whether policies written ``module:function`` may be imported; results of others may name any.
    """

    def __init__(self, imports: bool = False) -> None:
        self._imports = imports
        self._env: EcoDrivingEnv | None = None
        self._simulator = ""
        self._candidates: dict[tuple[Path, str], Candidate] = {}

    def __enter__(self) -> Player:
        return self

    def __exit__(self, *_: object) -> None:
        if self._env is not None:
            self._env.close(raise_if_closed=False)

    def replay(self, scene: Scene, note: Callable[[str], None] = lambda _: None) -> bytes:
        """Return a scene as compressed JSON: the net, and the episode under baseline and policy.

        Raises:
            IzooError: it cannot be played again; the message says why.
        """
        folder = scene.run.folder
        manifest = json.loads(files.read_text(folder / MANIFEST_FILE))
        fingerprint = manifest["policies"].get(scene.policy, "")
        parts = [FORMAT, code_digest(), manifest["settings"], fingerprint, *_key(scene)]
        digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:24]
        path = folder / FOLDER / f"{digest}.json.gz"
        with contextlib.suppress(OSError, EOFError, zlib.error, ValueError):
            packed = files.read_bytes(path)
            json.loads(gzip.decompress(packed))
            return packed
        note(f"Replaying {scene.context} under {scene.policy}.")
        packed = self._record(scene, manifest, fingerprint)
        with contextlib.suppress(OSError):  # a folder that cannot be written only costs the time of playing again
            path.parent.mkdir(exist_ok=True)
            files.write_bytes(path, packed, durable=False)
        return packed

    def _record(self, scene: Scene, manifest: dict[str, Any], fingerprint: str) -> bytes:
        sources = read_sources(scene.run.folder)
        context = sources.contexts.get(scene.context_hash)
        if context is None:
            raise IzooError(f"the folder does not hold the context {scene.context}.")
        config = dataclasses.replace(from_mapping(EnvConfig, manifest["settings"]["env"]), emit=("metrics",))
        candidate = self._candidate(scene, sources.policies.get(scene.policy), config, fingerprint)
        content: dict[str, Any] = {"frame_s": config.decision_s, "warmup_s": config.warmup_s}
        self._provide(config, manifest["settings"].get("simulator", "sumo"))
        for side, driver, played in (
            ("baseline", as_candidate(HUMAN, config), baseline_context(context)),
            ("policy", candidate, context),
        ):
            content[side] = self._play(driver, played, context, scene)
        assert self._env is not None
        content["net"] = geometry(self._env.road)
        return gzip.compress(json.dumps(content, separators=(",", ":")).encode(), mtime=0)

    def _provide(self, config: EnvConfig, simulator: str) -> None:
        """Have an environment of these settings on the simulator that played what is played again."""
        if self._env is None or (self._env.config, self._simulator) != (config, simulator):
            self.__exit__()
            self._env, self._simulator = EcoDrivingEnv(config=config, simulator=simulator), simulator

    def _play(self, driver: Candidate, played: Context, context: Context, scene: Scene) -> dict[str, Any]:
        assert self._env is not None
        env, recorder = self._env, Recorder()

        def watched(tensordict: TensorDictBase) -> TensorDictBase:
            recorder.take(env.scene())
            return driver.policy(tensordict)

        rows = run_episode(env, watched, driver.name, played, scene.seed)
        table = scene.run.table
        wanted = table[
            (table["policy"] == driver.name)
            & (table["context_hash"] == context.content_hash)
            & (table["seed"] == scene.seed)
        ].set_index("approach")
        same = all(
            abs(row[name] - wanted.loc[row["approach"], name]) <= 1e-6 * max(1.0, abs(row[name]))
            for row in rows
            for name in COMPARED
        )
        return {**recorder.content(), "name": driver.name, "as_evaluated": same}

    def _candidate(self, scene: Scene, source: str | None, config: EnvConfig, fingerprint: str) -> Candidate:
        if scene.policy in POLICY_FREE:
            return as_candidate(scene.policy, config)
        key = (scene.run.folder, scene.policy)
        if key not in self._candidates:
            for candidate in self._possible(scene, source, config):
                if candidate.fingerprint == fingerprint:
                    self._candidates[key] = candidate
                    break
            else:
                raise IzooError(f"the policy {scene.policy} has changed since it was evaluated; evaluate it again.")
        return self._candidates[key]

    def _possible(self, scene: Scene, source: str | None, config: EnvConfig) -> Iterator[Candidate]:
        """Yield what the policy may be: the recorded source, and the run's checkpoints."""
        folder, name = scene.run.folder, scene.policy
        places = [folder.resolve() / source] if source and source.endswith(".pt") else []
        if scene.run.run is not None:
            places += checkpoint.listed(scene.run.run)[::-1]
            places += [path for path in sorted(checkpoint.folder_of(scene.run.run).glob("*.pt")) if path not in places]
        if source and not places:
            if ":" in source and not zoo.named(source) and not self._imports:
                raise IzooError(f"the policy is the code {source}; imports=true allows to import it.")
            yield as_candidate(source, config, name)
            return
        if not places and scene.run.run is not None:
            raise IzooError(f"the run {scene.run.run} holds no checkpoint.")
        if not places:
            raise IzooError(f"the folder does not say what the policy {name} was made from; it was a Python object.")
        lost = [path for path in places if not path.is_file()]
        if len(lost) == len(places):
            raise IzooError(f"the checkpoint {lost[0]} is gone.")
        for path in places:
            if path.is_file():
                yield Candidate(name, *_loaded(path))


def _loaded(path: Path) -> tuple[Any, str]:
    from izoo.evaluation.fingerprint import fingerprint

    exported = zoo.named(str(path))
    policy = zoo.load(exported).policy if exported else runs.load_algorithm(path)[0].policy.eval()
    return policy, fingerprint(policy)


def _key(scene: Scene) -> list[Any]:
    return [scene.policy, scene.context_hash, scene.seed]
