"""Run folders: what a training run leaves behind, and how it is read back."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml

from izoo import zoo
from izoo.algos.learners.base import Algorithm, innermost
from izoo.algos.learners.registry import DRIVER_NAMES, make_algorithm
from izoo.conf.train_options import TrainConfig
from izoo.contexts.population import MAX_FILE_BYTES
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.errors import IzooError
from izoo.files import (
    claimed,
    ensure_empty,
    expanded,
    free_folder,
    read_bytes,
    reading,
    usable_paths,
    write_bytes,
    write_text,
)
from izoo.options import from_mapping, to_mapping
from izoo.results.policies import NamedPolicy, as_policy
from izoo.training import checkpoint
from izoo.training.loggers import LOGGER_FOLDERS

EVALUATIONS, LAST = "evaluations", "last"
"""Folder of a run with its results folders, and the one of them that is of its final evaluation."""
CONFIG_FILE, METRICS_FILE, CURVE_FILE = "config.yaml", "metrics.csv", "learning_curve.png"
NETWORK_OPTIONS = ("hidden", "activation", "initial_spread", "layers", "heads", "neighbours", "range_m")
"""Options of ``algo`` that decide what the weights of a policy mean."""


@contextlib.contextmanager
def created(config: TrainConfig) -> Iterator[Path]:
    """Make the folder of a new run, write its options, and give its absolute path; this process owns it.

    Where the block ends with an error before anything was learned, nothing is left behind.

    Raises:
        IzooError: the folder already holds something, cannot be made, or another process begins a run there.
    """
    label = f"{datetime.now():%Y-%m-%d_%H-%M-%S}-{config.algo.name}-seed{config.seed}"
    wanted = Path(config.run_dir) if config.run_dir else Path.cwd() / "runs" / label
    with usable_paths():
        existed = config.run_dir is not None and wanted.exists()
        above = [folder for folder in wanted.parents if not folder.exists()]
        run_dir = wanted if config.run_dir else free_folder(wanted)
    ensure_empty(run_dir, "run_dir", "go on with that run: resume=" + str(run_dir))
    with owned(run_dir):
        try:
            write_config(run_dir, config)
            yield run_dir
        except BaseException:
            if not checkpoint.listed(run_dir) and not (run_dir / METRICS_FILE).exists():
                _remove(run_dir, above if existed else [run_dir, *above])
            raise


@contextlib.contextmanager
def owned(run_dir: Path) -> Iterator[Path]:
    """Keep other processes from training in a run's folder, and give it; reading and evaluating into it they may.

    Raises:
        IzooError: another process trains there.
    """
    with claimed(checkpoint.folder_of(run_dir), "this run is being trained; wait for its end, or stop it"):
        yield run_dir


def _remove(run_dir: Path, made: Sequence[Path]) -> None:
    """Remove what a run has put into its folder, and the folders made for it that hold nothing else."""
    for path in (run_dir / CONFIG_FILE, *run_dir.glob("drivers-*.json")):
        path.unlink(missing_ok=True)
    for name in LOGGER_FOLDERS:
        shutil.rmtree(run_dir / name, ignore_errors=True)
    for folder in (checkpoint.folder_of(run_dir), *made):
        with contextlib.suppress(OSError):
            folder.rmdir()


def write_config(run_dir: Path, config: TrainConfig) -> None:
    """Write the resolved options as ``config.yaml``, and beside it copies of the files of drivers that they name."""
    values = to_mapping(dataclasses.replace(config, resume=None))
    for number, part in enumerate(with_drivers(values), 1):
        kept = run_dir / f"drivers-{number}.json"
        write_bytes(kept, read_bytes(Path(part["drivers"]), MAX_FILE_BYTES))
        part["drivers"] = kept.name
    write_text(run_dir / CONFIG_FILE, yaml.safe_dump(values, sort_keys=False))


def with_drivers(options: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the parts of a run's options, as plain values, that name a file of drivers."""
    contexts = options["contexts"]
    return [part for part in (contexts, *contexts.get("sources", ())) if part.get("drivers")]


def read_config(run_dir: Path, imports: bool = True) -> TrainConfig:
    """Read the options of a run.

    Args:
        run_dir: the run.
        imports: whether an algorithm that is written ``module:Class`` may be imported; runs of others may name any.

    Raises:
        IzooError: the folder is not a run, or its options cannot be read.
    """
    path = run_dir / CONFIG_FILE
    if not path.is_file():
        raise IzooError(f"{run_dir} has no {CONFIG_FILE}; give the folder of a training run.")
    with reading(path):
        values = yaml.safe_load(path.read_text())
        algorithm = str(values["algo"]["name"])
        if ":" in algorithm and not imports:
            raise IzooError(f"the run {run_dir} is of the code {algorithm}; imports=true allows to import it.")
        for part in with_drivers(values):
            part["drivers"] = str((run_dir / part["drivers"]).absolute())
        try:
            return from_mapping(TrainConfig, values)
        except IzooError as error:
            raise IzooError(f"{path}: {error}") from error


def resume_point(where: Path) -> tuple[Path, Path | None]:
    """Return the folder of a run to go on with, and the checkpoint to go on from; ``None``: it has saved none yet.

    Args:
        where: the folder, or one of its checkpoint files.
    """
    if (where / CONFIG_FILE).is_file() and not checkpoint.listed(where):
        return where, None
    path = checkpoint.find(where)
    return checkpoint.run_of(path), path


def resumed(where: Path) -> TrainConfig:
    """Return the options with which a run goes on: its own; see :func:`resume_point`."""
    run_dir, _ = resume_point(where)
    return dataclasses.replace(read_config(run_dir), run_dir=str(run_dir), resume=str(where))


def load_algorithm(where: Path | str) -> tuple[Algorithm, TrainConfig, dict[str, Any]]:
    """Rebuild a run's algorithm from its newest checkpoint.

    Args:
        where: a run folder, or one of its checkpoint files.

    Returns:
        The algorithm, the run's options, and the whole checkpoint.
    """
    path = checkpoint.find(expanded(where).absolute())
    config = read_config(checkpoint.run_of(path))
    state = checkpoint.load(path)
    algorithm = make_algorithm(config.algo, config.action, config.env)
    with reading(path):
        algorithm.load_state_dict(state["algorithm"])
    return algorithm, config, state


def start_from(algorithm: Algorithm, config: TrainConfig) -> None:
    """Give an algorithm the policy of the run that the option ``start`` names.

    Raises:
        IzooError: there is none, or it is a policy of other networks, observations, actions or decisions.
    """
    path = checkpoint.find(Path(config.start or ""))
    theirs, state = read_config(checkpoint.run_of(path)), checkpoint.load(path)
    if theirs.algo.starts_with != config.algo.starts_with:
        raise IzooError(
            f"start={config.start} is a run of algo={theirs.algo.name}, whose policy has other networks than that of "
            f"algo={config.algo.name}; ppo and mappo can begin with each other's, gcrl with its own."
        )
    here, there = _weight_options(config), _weight_options(theirs)
    for what, its in there.items():
        if here.get(what) != its:
            raise IzooError(f"start={config.start} is a run with other options ({what}: {its}); give the same here.")
    with reading(path):
        innermost(algorithm).policy.load_state_dict(state["algorithm"]["policy"])


def _weight_options(config: TrainConfig) -> dict[str, Any]:
    """Return the options that decide what the weights of a run's policy mean, by name."""
    options = to_mapping(config.algo)
    if hasattr(config.action, "spread"):
        options.pop("initial_spread", None)  # action.spread takes its place
    return {
        "action": to_mapping(config.action),
        "observes": observation_names(config.env),
        "seconds of a decision": config.env.decision_s,
        **{f"algo.{name}": options[name] for name in NETWORK_OPTIONS if name in options},
    }


def any_policy(policy: str, config: EnvConfig, name: str | None = None) -> NamedPolicy:
    """Return what :func:`izoo.results.policies.as_policy` does, or the policy of a run or one of its checkpoints.

    Raises:
        IzooError: there is no such policy, or it was trained on other observations or decisions.
    """
    path = expanded(policy).absolute()
    if policy in DRIVER_NAMES or zoo.named(policy) or not path.exists():
        return as_policy(policy, config, name)
    path = checkpoint.find(path)
    run_dir = checkpoint.run_of(path)
    algorithm, trained, state = load_algorithm(path)
    zoo.check_fits(f"the policy of {run_dir}", trained.env, config)
    found = as_policy(algorithm.policy.eval(), config, name or run_dir.name)
    origin = {"source": str(path), "algo": trained.algo.name, "frames": state["frames"]}
    record = dataclasses.replace(found.record, kind="trained", **origin)
    return found._replace(record=record, train_seed=trained.seed, trained=trained.env)
