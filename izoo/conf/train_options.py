"""Options of ``python -m izoo.train`` and ``python -m izoo.collect``, as frozen dataclasses."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from izoo.algos.action import ActionConfig, DirectAction
from izoo.algos.ppo_config import PPOConfig
from izoo.algos.registry import AlgoConfig
from izoo.conf.built_in import CityContexts
from izoo.conf.context_choices import ContextsConfig, PcgContexts
from izoo.envs.config import EnvConfig
from izoo.errors import check_range


@dataclass(frozen=True)
class CollectorConfig:
    """How environments are stepped.

    Attributes:
        name: ``parallel``: worker processes step together, the policy runs in this process; ``multisync``: one process
            per environment runs the policy as well; ``single``: one environment, in this process; ``ray``: as
            ``multisync``, over the machines of a Ray cluster (the one that RAY_ADDRESS names, or else this machine).
    """

    name: Literal["parallel", "single", "multisync", "ray"] = "parallel"


@dataclass(frozen=True)
class LoggerConfig:
    """Where metrics go besides ``metrics.csv``, which is always written.

    Attributes:
        name: ``csv`` (nothing else), ``wandb`` (offline and silent where no key is set) or ``tensorboard``.
        project: the project's name in Weights & Biases.
    """

    name: Literal["csv", "wandb", "tensorboard"] = "csv"
    project: str = "izoo"


@dataclass(frozen=True)
class CheckpointConfig:
    """When the state of a run is saved.

    Attributes:
        every_batches: batches between two checkpoints; one is always written at the end.
        keep: how many of the newest checkpoints are kept.
    """

    every_batches: int = 5
    keep: int = 3

    def __post_init__(self) -> None:
        check_range("checkpoint.every_batches", self.every_batches, 1, 10**9)
        check_range("checkpoint.keep", self.keep, 1, 10**6)


@dataclass(frozen=True)
class ValidationConfig:
    """The comparison with human driving, on held-out contexts, that runs beside training and chooses the best weights.

    Contexts and episodes are the same for every run with the same ``contexts``, whatever its seed.

    Attributes:
        every_batches: batches between two validations; weights that are due while one is still running wait, or give
            way to newer ones. The last weights of a run of this many batches or more are validated too. 0: never.
        contexts: how many contexts are drawn from the validation split; where contexts have no splits, or too few
            intersections for one, from the training contexts.
        seeds: paired episodes per context, 3 or more.
    """

    every_batches: int = 10
    contexts: int = 4
    seeds: int = 3

    def __post_init__(self) -> None:
        check_range("validation.every_batches", self.every_batches, 0, 10**9)
        check_range("validation.contexts", self.contexts, 1, 10**6)
        check_range("validation.seeds", self.seeds, 3, 10**6)


@dataclass(frozen=True)
class BriefEvaluationConfig:
    """The comparison with human driving that ends a training run, in episodes as long as those of training.

    Attributes:
        contexts: how many contexts are drawn for it; 0 leaves it out.
        seeds: paired episodes per context, 3 or more.
    """

    contexts: int = 2
    seeds: int = 3

    def __post_init__(self) -> None:
        check_range("evaluation.contexts", self.contexts, 0, 10**6)
        check_range("evaluation.seeds", self.seeds, 3, 10**6)


def training_env() -> EnvConfig:
    """Return the environment that training uses: learners need the agents alone, and fewer leaves are faster."""
    return EnvConfig(emit=())


@dataclass(frozen=True)
class TrainConfig:
    """Options of a training run.

    Attributes:
        algo: the algorithm and its hyper-parameters.
        action: whether the policy commands accelerations (``direct``) or corrects a scripted driver's (``residual``).
        contexts: which contexts episodes are drawn from.
        env: the environment.
        collector: how environments are stepped.
        logger: where metrics go besides the CSV.
        checkpoint: when the run's state is saved.
        validation: the comparison that goes on beside training, and chooses the best weights.
        evaluation: the comparison that ends the run.
        seed: base seed: episodes, drivers, network weights, exploration.
        num_workers: environments, each in a process of its own (but for ``collector=single``).
        device: where the learner's networks and replay live: ``cpu``, ``cuda``, or ``auto``: a GPU where there is one.
            Collection stays on the CPU. The presets' networks are small; a GPU pays off for larger ones.
        total_frames: environment steps of the whole run, over all workers.
        run_dir: folder of the run; null: ``runs/<date-time>-<algo>-seed<seed>`` in the current folder.
        resume: folder of a run to go on with; its own options are used, except ``total_frames`` and ``num_workers``
            where given.
    """

    algo: AlgoConfig = field(default_factory=PPOConfig)
    action: ActionConfig = field(default_factory=DirectAction)
    contexts: ContextsConfig = field(default_factory=CityContexts)
    env: EnvConfig = field(default_factory=training_env)
    collector: CollectorConfig = field(default_factory=CollectorConfig)
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    evaluation: BriefEvaluationConfig = field(default_factory=BriefEvaluationConfig)
    seed: int = 0
    num_workers: int = 2
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    total_frames: int = 195_000
    run_dir: str | None = None
    resume: str | None = None

    def __post_init__(self) -> None:
        check_range("seed", self.seed, 0, 2**31 - 1)
        check_range("num_workers", self.num_workers, 1, 1024)
        check_range("total_frames", self.total_frames, 1, 10**12)
        for name in ("run_dir", "resume"):
            _make_absolute(self, name)


@dataclass(frozen=True)
class CollectConfig:
    """Options of a data collection.

    Attributes:
        policy: a scripted driver (``random``, ``constant``, ``glide``, or ``uncommanded``: every controlled vehicle is
            left to IDM), or the folder of a training run.
        frames: environment steps to store.
        out: a new or empty folder for the data.
        contexts: which contexts episodes are drawn from.
        env: the environment, and with ``env.emit`` what is stored.
        shard_frames: most steps per shard, a set of memory-mapped files.
        seed: base seed: episodes, drivers, exploration.
        num_workers: environments, each in a process of its own.
    """

    policy: str = "random"
    frames: int = 10_000
    out: str | None = None
    contexts: ContextsConfig = field(default_factory=PcgContexts)
    env: EnvConfig = field(default_factory=EnvConfig)
    shard_frames: int = 100_000
    seed: int = 0
    num_workers: int = 2

    def __post_init__(self) -> None:
        check_range("frames", self.frames, 1, 10**12)
        check_range("shard_frames", self.shard_frames, 1, 10**9)
        check_range("seed", self.seed, 0, 2**31 - 1)
        check_range("num_workers", self.num_workers, 1, 1024)
        _make_absolute(self, "out")


def _make_absolute(config: object, name: str) -> None:
    """Resolve a path against the folder the command was given in, so that the saved options hold anywhere."""
    value = getattr(config, name)
    if value is not None:
        object.__setattr__(config, name, str(Path(value).expanduser().absolute()))
