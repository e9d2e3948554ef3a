"""Run folders: what a training run leaves behind, and how it is read back."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tensordict.nn import TensorDictModuleBase
from yaml import YAMLError

from izoo.algos.base import Algorithm
from izoo.algos.registry import make_algorithm
from izoo.conf.mapping import from_mapping, to_mapping
from izoo.conf.train_options import TrainConfig
from izoo.envs.mdp.frame import observation_names
from izoo.errors import IzooError
from izoo.files import ensure_empty, write_text
from izoo.training import checkpoint

CONFIG_FILE, METRICS_FILE, CURVE_FILE = "config.yaml", "metrics.csv", "learning_curve.png"


def create(config: TrainConfig) -> Path:
    """Make the folder of a new run and write its options; returns its absolute path.

    Raises:
        IzooError: the folder already holds something, or cannot be made.
    """
    label = f"{datetime.now():%Y-%m-%d_%H-%M-%S}-{config.algo.name}-seed{config.seed}"
    run_dir = Path(config.run_dir) if config.run_dir else Path.cwd() / "runs" / label
    ensure_empty(run_dir, "run_dir", "go on with that run: resume=" + str(run_dir))
    write_config(run_dir, config)
    return run_dir


def write_config(run_dir: Path, config: TrainConfig) -> None:
    """Write the resolved options as ``config.yaml``."""
    write_text(run_dir / CONFIG_FILE, OmegaConf.to_yaml(OmegaConf.create(to_mapping(config))))


def read_config(run_dir: Path) -> TrainConfig:
    """Read the options of a run.

    Raises:
        IzooError: the folder is not a run, or its options are of another version.
    """
    path = run_dir / CONFIG_FILE
    if not path.is_file():
        raise IzooError(f"{run_dir} has no {CONFIG_FILE}; give the folder of a training run.")
    try:
        values: Any = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
    except (OSError, YAMLError, OmegaConfBaseException) as error:
        raise IzooError(f"cannot read {path}: {str(error).splitlines()[0]}.") from error
    return from_mapping(TrainConfig, values)


def load_algorithm(where: Path | str) -> tuple[Algorithm, TrainConfig, dict[str, Any]]:
    """Rebuild a run's algorithm from its newest checkpoint.

    Args:
        where: a run folder, or one of its checkpoint files.

    Returns:
        The algorithm, the run's options, and the whole checkpoint.
    """
    path = checkpoint.find(Path(where).expanduser().absolute())
    config = read_config(checkpoint.run_of(path))
    state = checkpoint.load(path)
    check_layout(state["features"], config, path)
    algorithm = make_algorithm(config.algo, config.action, config.env)
    try:
        algorithm.load_state_dict(state["algorithm"])
    except (KeyError, RuntimeError, ValueError) as error:
        raise IzooError(
            f"{path} does not fit the options in {CONFIG_FILE} beside it: {str(error).splitlines()[0]}"
        ) from error
    return algorithm, config, state


def check_layout(features: int, config: TrainConfig, path: Path) -> None:
    """Raise :class:`IzooError` unless a checkpoint observes as many ``features`` as its run's options say."""
    expected = len(observation_names(config.env))
    if features != expected:
        raise IzooError(
            f"{path} was trained on an observation of {features} numbers per vehicle, and the options in {CONFIG_FILE} "
            f"describe one of {expected}: env.observed or env.neighbours were changed; restore them or train again."
        )


def load_policy(where: Path | str) -> TensorDictModuleBase:
    """Return the policy of a run folder or checkpoint file, ready to act on ``("agents", "observation")``."""
    return load_algorithm(where)[0].policy.eval()
