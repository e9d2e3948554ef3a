"""Replays: the best and the worst context of a policy, played again beside uncommanded, and kept in the folder."""

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

from tensordict import TensorDictBase

from izoo import files, zoo
from izoo.algos.learners.registry import DRIVER_NAMES
from izoo.contexts.context import Context
from izoo.envs import MODEL_VERSION
from izoo.envs.config import STEP, EnvConfig
from izoo.envs.env import EcoDrivingEnv
from izoo.errors import IzooError
from izoo.metrics.pairing import UNCOMMANDED
from izoo.report.recording import Recorder, geometry
from izoo.report.report_data import TRAIN_FOLDER, Evaluation
from izoo.report.tables import SAVED
from izoo.results.playing import Policy, run_episode
from izoo.results.policies import as_policy, weights_hash
from izoo.results.store import PolicyRecord, read_contexts
from izoo.training import checkpoint, run_folder
from izoo.zoo.catalog import WEIGHTS

FOLDER = "replays"
FORMAT = 4
COMPARED = ("crossed", "emission_g", "travel_time_s")
"""Sums by which a replay is recognised as the episode that was evaluated."""


@dataclass(frozen=True)
class Scene:
    """An episode to replay.

    Attributes:
        which: ``best`` or ``worst``.
        approach: the leg to look at.
        saved: CO2 over uncommanded in the context, in per cent, mean over episode seeds.
    """

    policy: str
    which: str
    context: str
    approach: str
    context_hash: str
    train_seed: int
    seed: int
    saved: float
    evaluation: Evaluation

    @property
    def record(self) -> PolicyRecord:
        """What is known of the policy."""
        return self.evaluation.manifest.policies.get(self.policy, {}).get(self.train_seed, PolicyRecord())

    def described(self) -> dict[str, Any]:
        """The scene as plain values for the page."""
        kept = ("policy", "which", "context", "approach", "context_hash", "saved")
        return {name: getattr(self, name) for name in kept} | {"seed": str(self.seed), "baseline": UNCOMMANDED}


def scenes(evaluation: Evaluation, policy: str) -> list[Scene]:
    """Return the contexts in which a policy saves most and least, in its best training seed.

    Saturated contexts are passed over where two others are left.
    """
    found = evaluation.contexts(policy).dropna(subset=[SAVED])
    if found.empty:
        return []
    best_seed = found.groupby("train_seed")[SAVED].median().idxmax()
    found = found[found["train_seed"] == best_seed].sort_values([SAVED, "context"], kind="stable")
    calm = found[~found["saturated"]]
    found = calm if len(calm) > 1 else found
    picked = [("best", found.iloc[-1])] + ([("worst", found.iloc[0])] if len(found) > 1 else [])
    rows = evaluation.table[(evaluation.table["policy"] == policy) & (evaluation.table["train_seed"] == best_seed)]
    scenes = []
    for which, row in picked:
        first = rows[rows["context_hash"] == row["context_hash"]].iloc[0]
        about = (
            policy,
            which,
            row["context"],
            first["approach"],
            row["context_hash"],
            int(best_seed),
            int(first["seed"]),
        )
        scenes.append(Scene(*about, float(row[SAVED]), evaluation))
    return scenes


class Player:
    """Plays episodes of results again; one simulator serves all.

    Args:
        imports: whether policies written ``module:function`` may be imported; results of others may name any.
    """

    def __init__(self, imports: bool = False) -> None:
        self._imports = imports
        self._env: EcoDrivingEnv | None = None
        self._simulator = ""
        self._policies: dict[tuple[Path, str, int], Policy] = {}

    def __enter__(self) -> Player:
        return self

    def __exit__(self, *_: object) -> None:
        if self._env is not None:
            self._env.close(raise_if_closed=False)

    def replay(self, scene: Scene, note: Callable[[str], None] = lambda _: None) -> bytes:
        """Return a scene as compressed JSON: the net, and the episode under uncommanded and under the policy.

        Raises:
            IzooError: it cannot be played again; the message says why.
        """
        folder, manifest = scene.evaluation.folder, scene.evaluation.manifest
        episode = [scene.policy, scene.train_seed, scene.context_hash, scene.seed]
        parts = [FORMAT, MODEL_VERSION, manifest.env, scene.record.weights, scene.record.env, *episode]
        digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:24]
        path = folder / FOLDER / f"{digest}.json.gz"
        with contextlib.suppress(OSError, EOFError, zlib.error, ValueError):
            packed = files.read_bytes(path, files.MOST_UNPACKED_BYTES)
            json.loads(files.unpacked(packed))
            return packed
        note(f"Replaying {scene.context} under {scene.policy}.")
        packed = self._record(scene)
        with contextlib.suppress(OSError):  # a folder that cannot be written only costs the time of playing again
            path.parent.mkdir(exist_ok=True)
            files.write_bytes(path, packed, durable=False)
        return packed

    def _record(self, scene: Scene) -> bytes:
        context = read_contexts(scene.evaluation.folder).get(scene.context_hash)
        if context is None:
            raise IzooError(f"the folder does not hold the context {scene.context}.")
        config = dataclasses.replace(
            scene.evaluation.manifest.config(scene.policy, scene.train_seed), emit=("metrics",)
        )
        if config.decide != STEP:  # the same episode, and every step of it is seen
            config = dataclasses.replace(config, hold_s=config.step_s)
        simulator = str(scene.evaluation.table["simulator"].iloc[0])
        if self._env is None or (self._env.config, self._simulator) != (config, simulator):
            self.__exit__()
            self._env, self._simulator = EcoDrivingEnv(config=config, simulator=simulator), simulator
        content: dict[str, Any] = {"frame_s": config.decision_s, "warmup_s": config.warmup_s}
        content["baseline"] = self._play(UNCOMMANDED, as_policy(UNCOMMANDED, config).policy, context, scene, 0)
        content["policy"] = self._play(scene.policy, self._policy(scene, config), context, scene, scene.train_seed)
        content["net"] = geometry(self._env.road)
        return gzip.compress(json.dumps(content, separators=(",", ":")).encode(), mtime=0)

    def _play(self, name: str, policy: Policy, context: Context, scene: Scene, train_seed: int) -> dict[str, Any]:
        assert self._env is not None
        env, recorder = self._env, Recorder()
        act = policy.bind(env) if hasattr(policy, "bind") else policy

        def watched(tensordict: TensorDictBase) -> TensorDictBase:
            recorder.take(env.scene())
            return act(tensordict)

        rows = run_episode(env, watched, context, scene.seed).rows
        table = scene.evaluation.table
        key = {"policy": name, "train_seed": train_seed, "context_hash": context.content_hash, "seed": scene.seed}
        wanted = table[(table[list(key)] == list(key.values())).all(axis=1)].set_index("approach")
        same = all(
            abs(row[sum_] - wanted.loc[row["approach"], sum_]) <= 1e-6 * max(1.0, abs(row[sum_]))
            for row in rows
            for sum_ in COMPARED
        )
        return {**recorder.content(), "name": name, "as_evaluated": same}

    def _policy(self, scene: Scene, config: EnvConfig) -> Policy:
        key = (scene.evaluation.folder, scene.policy, scene.train_seed)
        if key not in self._policies:
            for policy in self._possible(scene, config):
                if weights_hash(policy) == scene.record.weights:
                    self._policies[key] = policy
                    break
            else:
                raise IzooError(f"the policy {scene.policy} has changed since it was evaluated; evaluate it again.")
        return self._policies[key]

    def _possible(self, scene: Scene, config: EnvConfig) -> Iterator[Policy]:
        """Yield what the policy may be: the recorded source, or checkpoints of its run."""
        folder, source = scene.evaluation.folder.resolve(), scene.record.source
        trained = folder / TRAIN_FOLDER / scene.policy / f"seed{scene.train_seed}"
        run = scene.evaluation.run or (trained if trained.is_dir() else None)
        sources = [str(folder / source) if source.endswith(WEIGHTS) else source] if source else []
        sources += map(str, checkpoint.listed(run)[::-1] if run is not None else ())
        if not sources:
            raise IzooError(f"the folder does not say what the policy {scene.policy} was made from.")
        there = [each for each in sources if not each.endswith(WEIGHTS) or Path(each).is_file()]
        if not there:
            raise IzooError(f"the checkpoint {sources[0]} is gone.")
        for each in there:
            if not self._imports and not zoo.named(each):
                if ":" in each and not each.endswith(WEIGHTS):
                    raise IzooError(f"the policy is the code {each}; imports=true allows to import it.")
                place = files.expanded(each).absolute()
                if each not in DRIVER_NAMES and place.exists():  # a checkpoint, or the folder of a run
                    run_folder.read_config(checkpoint.run_of(checkpoint.find(place)), imports=False)
            yield run_folder.any_policy(each, config).policy
