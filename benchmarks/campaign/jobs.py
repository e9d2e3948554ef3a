"""A part of a campaign: what it trains and plays. What is done is skipped, and what was begun goes on.

What is trained follows from the run folders, and what is tested from the rows of the part's store.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch

from izoo import tasks, zoo
from izoo.algos.drivers.glide import Glide, GlideConfig
from izoo.algos.learners.registry import make_algorithm
from izoo.benchmarks import planner
from izoo.benchmarks.campaign.experiment import Entry, Experiment
from izoo.benchmarks.campaign.parallel_training import ParallelRuns
from izoo.benchmarks.campaign.training_runs import TrainingRuns
from izoo.cli.option_command import compose_config
from izoo.conf.train_options import TrainConfig
from izoo.contexts.context import Context
from izoo.contexts.source import ContextList
from izoo.cores import usable_cores
from izoo.envs import REFERENCE, SIMULATORS
from izoo.envs.config import EnvConfig
from izoo.metrics.pairing import BASELINES
from izoo.metrics.summary import TRAINING
from izoo.options import from_mapping, written
from izoo.report.plots import UNTRAINED
from izoo.report.report_data import TRAIN_FOLDER
from izoo.results.policies import as_policy
from izoo.results.rollout import Play, evaluated, missing, play_missing
from izoo.results.selection import EpisodeSeeds
from izoo.results.store import SHARED, Store
from izoo.tasks import Task, limited
from izoo.training import checkpoint, run_folder
from izoo.training.option_checks import check_options
from izoo.zoo import catalog

if TYPE_CHECKING:
    from izoo.benchmarks.campaign.__main__ import CampaignConfig

ROLES = ("train", "validation", "test")


class Job(NamedTuple):
    """A training run, or the tests of one policy on one simulator."""

    kind: Literal["train", "test"]
    entry: str
    seed: int
    simulator: str = ""

    def __str__(self) -> str:
        return f"{self.kind} {self.entry}, seed {self.seed}" + (f", {self.simulator}" if self.simulator else "")


class PartRun:
    """A part of an experiment, and its results folder.

    Args:
        experiment: which it is of.
        name: of the part.
        folder: of the campaign.
        machine: the campaign's options, of which those count that say how to run. Without a dataset that the part
            needs, what is there can be summed up.

    Raises:
        IzooError: the experiment names something that cannot be used.
    """

    def __init__(self, experiment: Experiment, name: str, folder: Path, machine: CampaignConfig) -> None:
        self.name, self.folder, self.machine = name, folder / name, machine
        self.experiment = experiment
        self.part = experiment.parts[name]
        self.entries = {each: ("scripted", Entry(policy=each)) for each in BASELINES} | experiment.entries_of(name)
        self.task = self._task()
        self.tests = {} if machine.dataset is None and reads_folder(self.part.task) else self._tests()
        trainer = self.part.trained_in
        self.trainer = self if trainer is None else PartRun(experiment, trainer, folder, machine)
        # Composed before anything runs, so that an option that does not fit stops the campaign at once.
        configs = {
            (entry, seed): self.trainer.options(entry.removesuffix(UNTRAINED), seed)
            for entry, (kind, of) in self.entries.items()
            if kind in ("trained", "untrained")
            for seed in range(of.seeds or self.part.seeds)
        }
        self.configs = configs
        trained = {key: config for key, config in configs.items() if self.entries[key[0]][0] == "trained"}
        validated = {entry for entry, (_, of) in self.entries.items() if of.select == "best"}
        self.runs = TrainingRuns(trained, self.trainer.folder, validated)
        for config in trained.values():
            check_options(config)
        self.store = Store(self.folder, task=self.task.name, config=evaluated(self.task.env))

    def _tests(self) -> dict[str, list[Context]]:
        """Return the contexts of the tests, by the name of their task; those of the training too, where played."""
        found = {self.task.name: self.task.test_set(self.part.contexts)}
        if self.part.training_contexts:
            seen = limited(self.task.train.build(), self.part.training_contexts, self.task.test_seed + 1)
            found[self.task.name + TRAINING] = seen
        return found

    def _task(self) -> Task:
        part = self.part
        path = self.machine.dataset if reads_folder(part.task) else None
        return tasks.make(part.task, adoption=part.adoption, cv_vehicle=part.cv_vehicle, path=path)

    @functools.cache  # noqa: B019 - as long as the command
    def _options(self, name: str) -> TrainConfig:
        entry = self.experiment.known(self.name)[name]
        said = {"contexts.adoption": self.part.adoption, "contexts.cv_vehicle": self.part.cv_vehicle}
        said |= {"contexts.path": self.machine.dataset if reads_folder(self.part.task) else None}
        said |= {"twin.threads": self.machine.threads}
        words = [f"task={self.part.task}", *self.part.train, *entry.train, "evaluation.contexts=0"]
        words += [f"{name}={written(value)}" for name, value in said.items() if value is not None]
        return compose_config(TrainConfig, last_of(words))

    def options(self, name: str, seed: int) -> TrainConfig:
        """Return the options of a training run."""
        start = self.experiment.known(self.name)[name].start
        run = None if start is None else str(self.folder / TRAIN_FOLDER / start / f"seed{seed}")
        return dataclasses.replace(self._options(name), seed=seed, start=run)

    def env(self, name: str) -> EnvConfig:
        """Return the environment of an entry's tests: its own, with episodes as the task has them."""
        kind, entry = self.entries[name]
        shipped = catalog.named(entry.policy or "")
        if kind in ("trained", "untrained"):
            own = self.configs[name, 0].env
        elif kind == "planner":
            own = planner.settings(self._planner(entry))
        elif shipped:
            own = zoo.load(shipped).env
        else:
            own = self.task.env
            own = own if ":" in (entry.policy or "") else own.with_accelerations()
        return evaluated(dataclasses.replace(own, emit=(), **{key: getattr(self.task.env, key) for key in SHARED}))

    def _planner(self, entry: Entry) -> planner.PlannerConfig:
        env = self.task.env.with_accelerations()
        return dataclasses.replace(from_mapping(planner.PlannerConfig, entry.planner), env=env)

    def jobs(self) -> list[Job]:
        """Return all jobs, seed by seed, so that a part that is not finished already compares every entry."""
        found = []
        for seed in range(max((seed + 1 for _, seed in self.configs), default=1)):
            for name, (kind, _) in self.entries.items():
                if seed and (name, seed) not in self.configs:
                    continue
                if kind == "trained" and self.part.trained_in is None:
                    found.append(Job("train", name, seed))
                found += [Job("test", name, seed, each) for each in self._simulators(kind, seed)]
        return found

    def _simulators(self, kind: str, seed: int) -> list[str]:
        """Return what plays the tests of a training seed; the planner needs worlds that can be branched."""
        able = [name for name in self.part.simulators if kind != "planner" or SIMULATORS[name].saves]
        most = self.part.sumo_seeds
        return [name for name in able if name != REFERENCE or most is None or seed < most]

    def missing(self) -> list[Job] | None:
        """Return the jobs whose frames or rows are not there; ``None``: the contexts are not here.

        Runs that are gone are not missed, if their tests have all been played.
        """
        if not self.tests:
            return None
        absent = [job for job in self.jobs() if not self._is_there(job)]
        untested = {(job.entry, job.seed) for job in absent if job.kind == "test"}
        return [job for job in absent if (job.entry, job.seed) in untested or self.has_begun(job)]

    def has_begun(self, job: Job) -> bool:
        """Whether a job is a training run that has a checkpoint."""
        return job.kind == "train" and self.runs.frames((job.entry, job.seed)) > 0

    def _is_there(self, job: Job) -> bool:
        if job.kind == "train":
            return self.runs.is_finished((job.entry, job.seed))
        return not any(missing(self.store, plays, job.simulator) for plays in self._plays(job).values())

    def play(self) -> None:
        """Do what is not done.

        Raises:
            IzooError: something in the folder does not belong to this part.
            KeyboardInterrupt: Ctrl-C; what was begun goes on at the next start.
        """
        with self.store.open():
            for contexts in self.tests.values():
                self.store.keep_contexts(contexts)
            jobs = self.jobs()
            todo = [job for job in jobs if not self._is_done(job)]
            print(f"\n{self.name}: {len(jobs) - len(todo)} of {len(jobs)} jobs are done already.", flush=True)
            with ParallelRuns(self.machine.runs_at_once) as beside:
                for number, job in enumerate(todo, len(jobs) - len(todo) + 1):
                    print(f"\n[{number}/{len(jobs)}] {self.name}: {job}", flush=True)
                    key = job.entry, job.seed
                    if job.kind == "test":
                        self._test(job)
                    elif self.machine.runs_at_once == 1:
                        self.runs.train(key)
                    else:
                        self.runs.train_in_parallel(beside, list(self._ready(todo, job)))

    def _ready(self, todo: list[Job], job: Job) -> Iterable[tuple[str, int]]:
        """Yield the runs that may begin with that of ``job``: those that do not wait for another one's end."""
        for other in todo[todo.index(job) :]:
            start = self.entries[other.entry][1].start
            if other.kind == "train" and (start is None or self.runs.is_trained((start, other.seed))):
                yield other.entry, other.seed

    def _is_done(self, job: Job) -> bool:
        trained = self.entries[job.entry][0] == "trained"
        if trained and not self.runs.is_trained((job.entry, job.seed)):
            return False
        if job.kind == "train":
            return True
        if self.store.done or trained:
            self._admit(job)
        return self._is_there(job)

    def _admit(self, job: Job) -> Any:
        """Tell the store which weights are tested, which drops rows of others, and return the policy."""
        kind, entry = self.entries[job.entry]
        env, known = self.env(job.entry), {}  # type: EnvConfig, dict[str, Any]
        given: Any = entry.policy
        if kind == "trained":
            run_dir = self.runs.run_dir((job.entry, job.seed))
            path = (checkpoint.best_of(run_dir) if entry.select == "best" else None) or checkpoint.find(run_dir)
            given, known = str(path), {"source": os.path.relpath(path, self.folder)}
        elif kind == "untrained":
            config = self.configs[job.entry, job.seed]
            given, known = untrained(config), {"kind": kind, "algo": config.algo.name}
        elif kind == "planner":
            given, known = planner.Planning(self._planner(entry)), {"source": self._planner(entry).source}
        elif entry.glide:
            given = Glide(env, from_mapping(GlideConfig, entry.glide))
        named = (run_folder.any_policy if isinstance(given, str) else as_policy)(given, env, job.entry)
        self.store.admit({(job.entry, job.seed): dataclasses.replace(named.record, **known)})
        return named.policy

    def _test(self, job: Job) -> None:
        policy = self._admit(job)
        options: dict[str, Any] = {"workers": self.machine.num_workers, "cache": self.machine.cache}
        if SIMULATORS[job.simulator].batched:
            options["workers"] = self.machine.threads or usable_cores()
        if self.entries[job.entry][0] == "planner":
            options |= {"record": ("team_reward",), "side_by_side": planner.AT_ONCE}
        for task, plays in self._plays(job).items():
            policies: Any = {} if job.entry in BASELINES else {(job.entry, job.seed): policy}
            play_missing(self.store, plays, policies, self.env(job.entry), job.simulator, task=task, **options)

    def _plays(self, job: Job) -> dict[str, list[Play]]:
        """Return what a job plays, by task: every training seed plays episodes of its own, what was not trained all.

        SUMO leaves contexts of the training to the twin, if both play.
        """
        kind, entry = self.entries[job.entry]
        each, seeds = self.task.test_episodes, max((seed + 1 for _, seed in self.configs), default=1)
        if job.simulator == REFERENCE and self.part.sumo_seeds is not None:
            seeds = min(seeds, self.part.sumo_seeds)
        beside_the_twin = job.simulator == REFERENCE and len(self.part.simulators) > 1
        own = range(seeds) if kind == "scripted" else (job.seed,)
        numbers = [k * each + episode for k in own for episode in range(each)]
        drawn = EpisodeSeeds(self.task.test_seed, max(numbers, default=0) + 1)
        return {
            task: [
                Play(job.entry, job.seed, context, drawn.of(context)[number])
                for context in (contexts if entry.contexts is None else limited(ContextList(contexts), entry.contexts))
                for number in numbers
            ]
            for task, contexts in self.tests.items()
            if not (task.endswith(TRAINING) and (kind == "planner" or beside_the_twin))
        }


def reads_folder(task: str) -> bool:
    """Whether a task's contexts lie in a folder that has to be named."""
    return any(hasattr(getattr(tasks.make(task), role), "path") for role in ROLES)


def untrained(config: TrainConfig) -> Any:
    """Return the policy with which a training run begins."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        policy: Any = make_algorithm(config.algo, config.action, config.env).policy
        return policy.eval()


def last_of(words: Iterable[str]) -> list[str]:
    """Return option words, of those that set the same one the last."""
    return list({word.partition("=")[0]: word for word in words}.values())
