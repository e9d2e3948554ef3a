"""Options of ``python -m izoo.train`` and ``python -m izoo.collect``, as frozen dataclasses."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from izoo.algos.actions.action_modes import ActionConfig, DirectAction
from izoo.algos.learners.registry import AlgoConfig, preset
from izoo.conf.built_in import CityContexts
from izoo.conf.context_choices import ContextsConfig, PcgContexts
from izoo.envs import REFERENCE, simulator_of
from izoo.envs.config import SPEED, STEP, EnvConfig
from izoo.errors import IzooError
from izoo.files import make_absolute
from izoo.options import CheckedOptions, Ranges

TWIN_ENVS = 64
"""Environments on the twin where nothing is said."""
MAX_ENVS = 65536
CHANGEABLE = (
    *("total_frames", "num_workers", "num_envs", "twin", "device", "collector"),
    *("logger", "validation", "evaluation", "checkpoint", "resume"),
)
"""Options that may differ when a run is resumed; the others are part of what the run is."""


@dataclass(frozen=True)
class TwinConfig(CheckedOptions):
    """How the twin runs; of no concern on SUMO.

    Attributes:
        threads: threads that share the environments out among them; null: one per core.
        surrogate: what computes CO2: ``torch``, the module in one call for all vehicles; ``cuda``, the same on a GPU;
            or ``compiled``, the same function without torch, which is faster on a CPU.
    """

    threads: int | None = None
    surrogate: Literal["torch", "cuda", "compiled"] = "torch"
    group = "twin"
    ranges = (("threads", 1, 1024),)


@dataclass(frozen=True)
class TrainingTwinConfig(TwinConfig):
    """How a training run uses the twin; of no concern on SUMO. It has the options of :class:`TwinConfig`, too.

    Attributes:
        stagger: environments of a training run begin at random phases of their first episodes, so that every batch sees
            all times of an episode; until then CVs are uncommanded, and these episodes are left out of what is logged.
            false: all episodes begin, and end, together.
        compare_every: every Nth training episode is compared with the same one under human and under uncommanded
            driving, which the learning curve shows; these are played during training, and kept in the cache. 0: none.
    """

    stagger: bool = True
    compare_every: int = 8
    ranges = (("compare_every", 0, 10**6),)


@dataclass(frozen=True)
class LevelsConfig(CheckedOptions):
    """Which contexts are played in training; a level is a context with the seed of its episode.

    "PLR" is arXiv 2010.03934.

    Attributes:
        draw: ``uniform``: every episode draws a context anew; ``prioritised``: some play a level again that promises to
            teach (PLR). That needs the advantages of PPO, MAPPO or graph RL, and the twin.
        share: share of the episodes that play a level again, once half of ``kept`` are known (PLR: more and more; ours
            0.5).
        kept: how many levels are kept: those with the greatest scores (PLR: all of a finite set; ours 256).
        score: of a level: the mean over its agent-steps of the advantage's ``magnitude`` (PLR), or of its ``positive``
            part, what went better than expected.
        temperature: a level's probability is proportional to its rank to the power of -1/temperature (PLR 0.1; ours
            the same).
        staleness: share of the chance that goes by how long ago a level was played instead (PLR 0.1; ours the same).
    """

    draw: Literal["uniform", "prioritised"] = "uniform"
    share: float = 0.5
    kept: int = 256
    score: Literal["magnitude", "positive"] = "magnitude"
    temperature: float = 0.1
    staleness: float = 0.1
    group = "levels"
    ranges = (("share staleness", 0.0, 1.0), ("kept", 1, 10**6), ("temperature", 0.01, 100.0))


@dataclass(frozen=True)
class LoggerConfig(CheckedOptions):
    """Where metrics go besides ``metrics.csv``, which is always written.

    Attributes:
        name: ``csv`` (nothing else), ``wandb`` (offline and silent where no key is set) or ``tensorboard``.
        project: the project's name in Weights & Biases.
    """

    name: Literal["csv", "wandb", "tensorboard"] = "csv"
    project: str = "izoo"
    group = "logger"


@dataclass(frozen=True)
class CheckpointConfig(CheckedOptions):
    """When the state of a run is saved.

    Attributes:
        every_batches: batches between two checkpoints; one is always written at the end.
        keep: how many of the newest checkpoints are kept.
    """

    every_batches: int = 5
    keep: int = 3
    group = "checkpoint"
    ranges = (("every_batches", 1, 10**9), ("keep", 1, 10**6))


@dataclass(frozen=True)
class ValidationConfig(CheckedOptions):
    """The comparison with human driving, on held-out contexts, that runs beside training and chooses the best weights.

    Contexts and episodes are the same for every run with the same ``contexts``, whatever its seed.

    Attributes:
        every_batches: batches between two validations; weights that are due while one is still running wait, or give
            way to newer ones. The last weights of a run of this many batches or more are validated too. 0: never.
        contexts: how many contexts are drawn from the validation split; where contexts have no splits, or too few
            intersections for one, from the training contexts. The more, the smaller the losses that keep weights from
            becoming the best.
        seeds: paired episodes per context.
        simulator: what plays them: ``sumo``, which is what counts, or ``twin``, its compiled copy.
    """

    every_batches: int = 10
    contexts: int = 8
    seeds: int = 3
    simulator: str = REFERENCE
    group = "validation"
    ranges = (("every_batches", 0, 10**9), ("contexts seeds", 1, 10**6))

    def __post_init__(self) -> None:
        super().__post_init__()
        simulator_of(self.simulator, "validation.simulator")


@dataclass(frozen=True)
class BriefEvaluationConfig(CheckedOptions):
    """The comparison with human driving that ends a training run, in episodes as long as those of training.

    Attributes:
        contexts: how many contexts are drawn for it; 0 leaves it out.
        seeds: paired episodes per context.
    """

    contexts: int = 2
    seeds: int = 3
    group = "evaluation"
    ranges = (("contexts", 0, 10**6), ("seeds", 1, 10**6))


@dataclass(frozen=True)
class RolloutConfig(CheckedOptions):
    """Where environments are stepped, and how many.

    Attributes:
        simulator: ``sumo``, or ``twin``, its compiled copy: many environments in this process.
        seed: base seed: episodes, drivers, network weights, exploration.
        num_workers: environments on SUMO, each in a process of its own.
        num_envs: environments on the twin; null: 64.
    """

    simulator: str = REFERENCE
    seed: int = 0
    num_workers: int = 2
    num_envs: int | None = None
    ranges: ClassVar[Ranges] = (("seed", 0, 2**31 - 1), ("num_workers", 1, 1024), ("num_envs", 1, MAX_ENVS))

    def __post_init__(self) -> None:
        super().__post_init__()
        chosen = simulator_of(self.simulator)
        if self.num_envs is not None and not chosen.batched:
            raise IzooError(
                f"num_envs is {self.num_envs}, but on {chosen.label} every environment is a process: set num_workers, "
                "or choose simulator=twin."
            )

    @property
    def environments(self) -> int:
        """How many environments are stepped side by side."""
        return self.num_workers if not simulator_of(self.simulator).batched else self.num_envs or TWIN_ENVS


def training_env() -> EnvConfig:
    """Return the environment that training uses: learners need the agents alone, and fewer leaves are faster."""
    return EnvConfig(emit=())


@dataclass(frozen=True)
class TrainConfig(RolloutConfig):
    """Options of a training run.

    Attributes:
        task: a task of :mod:`izoo.tasks`, which sets the contexts, the environment, what actions stand for and the
            simulator, where these are not given; null: none.
        algo: the algorithm and its hyper-parameters.
        action: whether the policy commands accelerations (``direct``), desired speeds that the vehicle's own
            car-following keeps to (``speed``), says when vehicles should arrive (``arrive``), advises the simulator's
            own driver (``advise``) or corrects a scripted one (``residual``).
        contexts: which contexts episodes are drawn from.
        levels: which of these are played.
        env: the environment.
        collector: how environments are stepped. ``parallel``: worker processes step together, the policy runs in this
            process; ``multisync``: one process per environment runs the policy as well; ``single``: one environment,
            in this process; ``ray``: as ``multisync``, over the machines of a Ray cluster (the one that RAY_ADDRESS
            names, or else this machine). On the twin it is ``parallel``.
        logger: where metrics go besides the CSV.
        checkpoint: when the run's state is saved.
        validation: the comparison that goes on beside training, and chooses the best weights.
        evaluation: the comparison that ends the run.
        simulator: ``sumo``, or ``twin``, its compiled copy: many environments in this process. The comparison that ends
            the run is on SUMO either way.
        twin: how the twin runs.
        num_workers: environments on SUMO, each in a process of its own (but for ``collector=single``), and workers
            of the final evaluation.
        device: where the learner's networks and replay live: ``cpu``, ``cuda``, or ``auto``: a GPU where there is one.
            Collection stays on the CPU. A GPU pays off for PPO with large batches, or for larger networks.
        total_frames: environment steps of the whole run, over all workers.
        start: a run, or one of its checkpoints, whose policy this run begins with (PPO, MAPPO and graph RL); what it
            observes and what its actions stand for must be the same. The value function and all else begin anew. null:
            random weights.
        run_dir: folder of the run; null: ``runs/<date-time>-<algo>-seed<seed>`` in the current folder.
        resume: folder of a run to go on with; its own options are used, but for those of how it is run, where given:
            ``total_frames``, ``num_workers``, ``num_envs``, ``twin``, ``device``, ``collector``, ``logger``,
            ``validation``, ``evaluation`` and ``checkpoint``.
    """

    task: str | None = None
    algo: AlgoConfig = field(default_factory=functools.partial(preset, "ppo"))
    action: ActionConfig = field(default_factory=DirectAction)
    contexts: ContextsConfig = field(default_factory=CityContexts)
    levels: LevelsConfig = field(default_factory=LevelsConfig)
    env: EnvConfig = field(default_factory=training_env)
    collector: Literal["parallel", "single", "multisync", "ray"] = "parallel"
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    evaluation: BriefEvaluationConfig = field(default_factory=BriefEvaluationConfig)
    twin: TrainingTwinConfig = field(default_factory=TrainingTwinConfig)
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    total_frames: int = 195_000
    start: str | None = None
    run_dir: str | None = None
    resume: str | None = None
    role: ClassVar[str] = "train"
    """Whose contexts of a task are meant."""
    ranges = (("total_frames", 1, 10**12),)

    def __post_init__(self) -> None:
        super().__post_init__()
        simulator = simulator_of(self.simulator)
        if simulator.batched and self.collector != "parallel":
            raise IzooError(
                f"collector={self.collector} is a way to step environments in processes; with simulator="
                f"{self.simulator} leave collector out, and set num_envs."
            )
        if not self.action.commands and self.env.action == SPEED:
            raise IzooError(
                f"env.action=speed takes desired speeds, but the policy's actions are those of action="
                f"{self.action.name}; choose action=speed or arrive, or env.action=acceleration."
            )
        emit = tuple(dict.fromkeys((*self.env.emit, *self.algo.emits)))
        object.__setattr__(self, "env", dataclasses.replace(self.env, emit=emit, **self.action.commands))
        self.algo.check_run(self)
        if self.levels.draw == "prioritised" and not simulator.saves:
            raise IzooError(
                f"levels.draw=prioritised saves its place with the simulator, which {simulator.label} cannot; choose "
                "simulator=twin, or levels.draw=uniform."
            )
        make_absolute(self, "start", "run_dir", "resume")

    @property
    def environments(self) -> int:
        """How many environments are stepped side by side."""
        return 1 if self.collector == "single" else super().environments

    @property
    def batch_frames(self) -> int:
        """Steps of a batch over all environments: ``algo.frames_per_batch``, as a multiple of their number.

        Where policies are compared, it is an episode of each.
        """
        if self.algo.candidates > 1:
            return self.environments * self.env.decisions
        return -(-self.algo.frames_per_batch // self.environments) * self.environments

    @property
    def staggered(self) -> int:
        """How many of the first episodes begin at random phases."""
        by_step = self.env.decide == STEP and self.algo.candidates == 1
        return self.environments if simulator_of(self.simulator).saves and self.twin.stagger and by_step else 0


@dataclass(frozen=True)
class CollectConfig(RolloutConfig):
    """Options of a data collection.

    Attributes:
        policy: a scripted driver (``random``, ``constant``, ``glide``, or ``uncommanded``: every controlled vehicle
            is left alone), a trained policy that ships (``zoo:NAME``) or was exported (``FILE.pt``), the folder of a
            training run, or one's own, ``module:function``.
        frames: environment steps to store.
        out: a new or empty folder for the data.
        contexts: which contexts episodes are drawn from.
        env: the environment, and with ``env.emit`` what is stored besides the agents.
        twin: how the twin runs.
    """

    policy: str = "random"
    frames: int = 10_000
    out: str | None = None
    contexts: ContextsConfig = field(default_factory=PcgContexts)
    env: EnvConfig = field(default_factory=training_env)
    twin: TwinConfig = field(default_factory=TwinConfig)
    ranges = (("frames", 1, 10**12),)

    def __post_init__(self) -> None:
        super().__post_init__()
        make_absolute(self, "out")
