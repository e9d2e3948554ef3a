"""Offline data: what a policy experiences, as memory-mapped TensorDicts in shards, with a manifest."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import ImmutableDatasetWriter, TensorDictReplayBuffer
from torchrl.envs.utils import ExplorationType

from izoo import __version__, zoo
from izoo.algos.drivers.by_name import make_driver
from izoo.algos.drivers.random import RandomDriver
from izoo.algos.learners.registry import DRIVER_NAMES
from izoo.conf.mapping import to_mapping, with_given
from izoo.conf.train_options import MAX_ENVS, TWIN_ENVS, CollectConfig
from izoo.console import Progress, graceful_interrupt, workers_ignore_interrupts
from izoo.contexts.source import RandomSchedule
from izoo.envs import SumoParallelEnv, TwinEnv
from izoo.envs.env import EcoDrivingBase
from izoo.envs.mdp.frame import observation_names
from izoo.errors import IzooError, UnfinishedError, check_range
from izoo.files import NO_ROOM, claimed_empty, expanded, write_json
from izoo.gpu import check_gpu
from izoo.results.playing import Policy
from izoo.results.policies import import_policy
from izoo.training import run_folder
from izoo.training.shards import ShardStorage, as_they_are, check_files, reserve

MANIFEST = "manifest.json"
FORMAT = "izoo-steps-2"
SCRIPTED = tuple(name for name in DRIVER_NAMES if name != "human")
"""Drivers by name; human driving is a matter of the contexts (``contexts.adoption=0``), not of a policy."""
FRAMES_PER_BATCH = 1000


def collect(config: CollectConfig, given: frozenset[str] = frozenset()) -> Path:
    """Step environments with a policy and store every step.

    The folder holds ``shard-00000``, ... and ``manifest.json``, which lists the finished shards and is replaced whole
    after each of them: what it names is complete, whenever the command is stopped. Shards are written beside and
    renamed.

    Args:
        config: the options.
        given: names of the options that were written on the command line; matters where a policy ships with its own.

    Returns:
        The folder.

    Raises:
        IzooError: ``out`` is missing, not empty or in use, or the policy or the contexts cannot be used.
        UnfinishedError: nothing more can be written.
        KeyboardInterrupt: after Ctrl-C, once what was collected is a whole data set.
    """
    if config.out is None:
        raise IzooError("out is missing; name a new folder for the data: out=DIR.")
    out = Path(config.out)
    shipped = zoo.named(config.policy)
    if shipped:
        env = with_given(zoo.load(shipped).env, config.env, given, "env")
        config = dataclasses.replace(config, env=env)
    policy = make_policy(config)
    source = config.contexts.build()
    with claimed_empty(out, "out"):
        collector = _make_collector(config, policy, RandomSchedule(source, config.seed))
        writer = ShardWriter(config, out)
        try:
            with graceful_interrupt() as interrupt, Progress(config.frames) as bar:
                for batch in collector:
                    writer.write(batch.transpose(0, 1).reshape(-1))
                    bar.update(writer.frames)
                    if interrupt.requested or writer.frames >= config.frames:
                        break
            writer.finish_shard()
        except OSError as error:
            kept = f"; shards that its {MANIFEST} names are complete" if (out / MANIFEST).exists() else ""
            text = f"could not write to {out}: {error}{kept}"
            remedy = "Make room, then collect" if error.errno in NO_ROOM else "Collect"
            raise UnfinishedError(f"{text}. {remedy} the rest into another folder.") from error
        finally:
            writer.discard()
            collector.shutdown()
    print(f"Data: {out}", flush=True)
    if interrupt.requested:
        raise KeyboardInterrupt
    return out


def _make_collector(config: CollectConfig, policy: Policy, schedule: RandomSchedule) -> Collector:
    """Return the source of batches, which has begun its first episodes."""
    with workers_ignore_interrupts():
        env = _make_env(config, schedule)
        torch.manual_seed(config.seed)
        try:
            return Collector(
                env,
                policy,
                frames_per_batch=-(-FRAMES_PER_BATCH // env.batch_size.numel()) * env.batch_size.numel(),
                total_frames=-1,
                exploration_type=ExplorationType.RANDOM,
                trust_policy=True,
                auto_register_policy_transforms=False,
            )
        except BaseException:
            if not env.is_closed:
                env.close()
            raise


def _make_env(config: CollectConfig, schedule: RandomSchedule) -> EcoDrivingBase:
    if config.simulator == "sumo":
        return SumoParallelEnv(_environments(config), contexts=schedule, config=config.env, seed=config.seed, shard=0)
    twin = config.twin
    if twin.surrogate == "cuda":
        check_gpu("twin.surrogate", "torch")
    return TwinEnv(
        _environments(config),
        schedule,
        config=config.env,
        seed=config.seed,
        shard=0,
        threads=twin.threads,
        surrogate=twin.surrogate,
    )


def _environments(config: CollectConfig) -> int:
    """Return how many environments step together."""
    if config.simulator == "sumo":
        return config.num_workers
    return TWIN_ENVS if config.num_envs is None else config.num_envs


def make_policy(config: CollectConfig) -> Policy:
    """Return the policy that ``config.policy`` names: a driver, one that ships, one's own, or a run's."""
    if config.policy == "random":
        return RandomDriver(seed=config.seed, config=config.env)
    if config.policy in SCRIPTED:
        return make_driver(config.policy, config.env)
    shipped = zoo.named(config.policy)
    if shipped:
        found = zoo.load(shipped)
        found.check_observed(config.env)
        return found.policy
    if ":" in config.policy and not expanded(config.policy).exists():
        policy = import_policy(config.policy)
        return policy.eval() if isinstance(policy, nn.Module) else policy
    algorithm, trained, _ = run_folder.load_algorithm(config.policy)
    if observation_names(trained.env) != observation_names(config.env):
        raise IzooError(
            f"the policy of {config.policy} was trained on other observations than env describes; "
            "set env.observed and env.neighbours as in its config.yaml."
        )
    zoo.check_actions(f"the policy of {config.policy}", trained.env, config.env)
    if trained.env.decision_s != config.env.decision_s:
        raise IzooError(
            f"the policy of {config.policy} decides every {trained.env.decision_s:g} s, and env every "
            f"{config.env.decision_s:g} s; set env.hold_s={trained.env.decision_s:g}."
        )
    return algorithm.policy.eval()


def load(folder: Path | str) -> TensorDictBase:
    """Open a collected data set.

    Returns:
        Steps ``[frames]``, in the order of collection: environment after environment within a time step. One shard
        stays memory-mapped, nothing is read; several are put together in memory, which :func:`replay_buffer`, where
        steps that follow each other stand beside each other, does not do.

    Raises:
        IzooError: the folder is not a finished data set of izoo, or a shard is missing.
    """
    shards = load_shards(folder)
    return shards[0] if len(shards) == 1 else torch.cat(shards)


def replay_buffer(folder: Path | str, **options: Any) -> TensorDictReplayBuffer:
    """Open a data set of any number of shards as a read-only replay buffer, memory-mapped, without copying.

    It holds the steps of one environment after those of another, each in the order of time, so that TorchRL's
    ``SliceSampler`` draws slices of episodes, once it is told which step is of which (:func:`trajectories`).

    Args:
        folder: what ``out=`` named.
        options: of :class:`torchrl.data.TensorDictReplayBuffer`, such as ``batch_size``, ``sampler`` or ``transform``.

    Raises:
        IzooError: the data set cannot be read, or an option is one that a data set determines.
    """
    ours = [name for name in ("storage", "writer", "collate_fn") if name in options]
    if ours:
        raise IzooError(
            f"replay_buffer() takes no {', '.join(ours)}: a data set is read only, in a storage of its own."
        )
    return TensorDictReplayBuffer(
        storage=_storage(folder), writer=ImmutableDatasetWriter(), collate_fn=as_they_are, **options
    )


def trajectories(folder: Path | str) -> Tensor:
    """Return numbers of the episodes that the steps of :func:`replay_buffer` are of, ``[frames]``.

    For ``SliceSampler(slice_len=20, trajectories=trajectories(folder), cache_values=True)``: with the name of a key
    instead, it reads the whole data set for every batch.
    """
    return _storage(folder).leaf(("collector", "traj_ids"))


def _storage(folder: Path | str) -> ShardStorage:
    return ShardStorage(load_shards(folder), environments=_read_manifest(folder)[0])


def load_shards(folder: Path | str) -> list[TensorDictBase]:
    """Open the shards of a data set, each ``[frames of the shard]``, memory-mapped; see :func:`load`."""
    folder = expanded(folder)
    shards = [(folder / name, frames) for name, frames in _read_manifest(folder)[1]]
    missing = [shard.name for shard, _ in shards if not shard.is_dir()]
    if missing or not shards:
        raise IzooError(f"{folder} lacks {', '.join(missing) or 'any shard'}; copy it whole, or collect again.")
    try:
        leaves = [check_files(shard) for shard, _ in shards]
        if any(found != leaves[0] for found in leaves):
            raise ValueError("its shards hold different things")
        # Pickled values would run what a foreign data set holds.
        opened = [(TensorDict.load_memmap(shard, allow_pickle=False), frames) for shard, frames in shards]
        if any(not 1 <= frames <= len(steps) for steps, frames in opened):
            raise ValueError(f"its shards have {[len(steps) for steps, _ in opened]} frames, not as {MANIFEST} says")
    except (RuntimeError, OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise IzooError(f"{folder} cannot be read: {text}; copy it whole, or collect again.") from error
    # A collection that Ctrl-C ended leaves room at the end of its last shard.
    return [steps if len(steps) == frames else steps[:frames] for steps, frames in opened]


def _read_manifest(folder: Path | str) -> tuple[int, list[tuple[str, int]]]:
    """Return how many environments stepped together, and name and frames of every shard."""
    path = expanded(folder) / MANIFEST
    if not path.is_file():
        raise IzooError(f"{path.parent} has no {MANIFEST}; give a folder that python -m izoo.collect has written.")
    try:
        manifest = json.loads(path.read_text())
        form = manifest.get("format")
        shards = [(Path(shard["name"]).name, int(shard["frames"])) for shard in manifest["shards"]]
        environments = int(manifest["environments"]) if form == FORMAT else 1
        check_range("environments", environments, 1, MAX_ENVS)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise IzooError(f"{path} is damaged; collect the data again.") from error
    if form != FORMAT:
        raise IzooError(f"{path} is of format {form!r}; this version of izoo reads {FORMAT}.")
    return environments, shards


class ShardWriter:
    """Writes steps into memory-mapped shards of a given length, and the manifest after each finished one.

    Args:
        config: options of the collection.
        out: an empty folder.
    """

    def __init__(self, config: CollectConfig, out: Path) -> None:
        self.config, self.out = config, out
        self.frames = 0
        self._shards: list[dict[str, Any]] = []
        self._open: TensorDictBase | None = None
        self._filled = 0

    def write(self, steps: TensorDictBase) -> None:
        """Append ``steps [n]``, as far as they are still wanted."""
        steps = steps[: self.config.frames - self.frames]
        while len(steps) > 0:
            if self._open is None:
                length = min(self.config.shard_frames, self.config.frames - self.frames)
                self._open = steps[0].expand(length).memmap_like(str(self._partial))
                reserve(self._partial)
                self._filled = 0
            part = steps[: len(self._open) - self._filled]
            self._open[self._filled : self._filled + len(part)] = part
            self._filled += len(part)
            self.frames += len(part)
            steps = steps[len(part) :]
            if self._filled == len(self._open):
                self.finish_shard()

    def finish_shard(self) -> None:
        """Put the shard that is being filled in its place, and name it in the manifest."""
        if self._open is None:
            return
        name = f"shard-{len(self._shards):05d}"
        self._open = None
        self._partial.rename(self.out / name)
        self._shards.append({"name": name, "frames": self._filled})
        self._write_manifest()

    def discard(self) -> None:
        """Remove what was not finished."""
        shutil.rmtree(self._partial, ignore_errors=True)

    @property
    def _partial(self) -> Path:
        return self.out / ".shard.partial"

    def _write_manifest(self) -> None:
        manifest = {
            "format": FORMAT,
            "izoo": __version__,
            "frames": sum(shard["frames"] for shard in self._shards),
            "simulator": self.config.simulator,
            "environments": _environments(self.config),
            "observation_names": list(observation_names(self.config.env)),
            "shards": self._shards,
            "options": to_mapping(self.config),
        }
        write_json(self.out / MANIFEST, manifest)
