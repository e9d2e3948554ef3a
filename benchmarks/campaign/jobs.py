"""A benchmark as a list of jobs over one results folder: what is done is skipped, what was begun goes on.

What is trained follows from the run folders, and what is tested from the rows of the store.
"""

from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from izoo.algos.drivers.glide import Glide, GlideConfig
from izoo.benchmarks.campaign.comparing import check_settings, summaries
from izoo.benchmarks.campaign.generalization_options import SWEPT, Entry, GeneralizationConfig
from izoo.benchmarks.campaign.parallel_training import ParallelRuns
from izoo.benchmarks.campaign.policies import selected, untrained
from izoo.benchmarks.campaign.task_plan import evaluation_env, make_plan, train_config
from izoo.benchmarks.campaign.training_runs import Key, TrainingRuns
from izoo.conf.mapping import to_mapping
from izoo.envs.twin import backend
from izoo.envs.twin.net.supported import check_contexts
from izoo.metrics.summary import TRAINING, Summary
from izoo.results.policies import as_policy
from izoo.results.rollout import Play, Policy, missing, play_missing
from izoo.results.store import Store
from izoo.training import checkpoint, run_folder
from izoo.training.loggers import MetricsTable
from izoo.training.option_checks import check_options
from izoo.training.plots import compare_curves

CURVES_FILE = "learning_curves.png"
MAY_DIFFER = ("out", "num_workers", "runs_at_once", "cache", "human_vehicles", "trained_in", "verbose")
"""Options that change no number (but for rounding, where a run has fewer cores)."""
MAY_GROW = ("algos", "seeds", "untrained_seeds", "test_limit", "train_contexts", "eval_seeds", "floors_mps", *SWEPT)
"""Options that may get more values than before; what is there stays."""


@dataclass(frozen=True)
class Job:
    """One training run or one evaluation."""

    kind: Literal["train", "evaluate"]
    entry: Entry
    seed: int

    @property
    def key(self) -> Key:
        """The entry's name and the training seed."""
        return self.entry.name, self.seed

    def __str__(self) -> str:
        return f"{self.kind} {self.entry.name}" + (f", seed {self.seed}" if self.entry.seeded else "")


class Campaign:
    """A benchmark of resolved options, and its results folder.

    Raises:
        IzooError: the options name something that cannot be used.
    """

    def __init__(self, config: GeneralizationConfig, folder: Path) -> None:
        self.config, self.folder = config, folder
        self.entries = config.entries()
        self.plan = make_plan(config)
        self.tests = {self.plan.task: self.plan.test}
        if self.plan.seen:
            self.tests[self.plan.task + TRAINING] = self.plan.seen
        if config.human_vehicles:
            as_humans = [context.replace(cv_vehicle="human") for context in self.plan.test]
            self.tests[f"{self.plan.task}, human vehicles"] = as_humans
        self.envs = {entry.name: evaluation_env(config, entry) for entry in self.entries}
        # Composed before anything runs, so that an option that does not fit stops the benchmark at once.
        wanted = {
            (entry.name, seed): train_config(config, self.plan, entry, seed)
            for entry in self.entries
            if entry.kind == "trained"
            for seed in config.seeds_of(entry)
        }
        self.runs = TrainingRuns(wanted, folder, owes_validation=config.select == "best")
        self._check_simulators()
        self.store = Store(folder, task=self.plan.task, config=evaluation_env(config))

    def _check_simulators(self) -> None:
        """Raise :class:`IzooError` where a run or the twin cannot play what it shall, before anything is played."""
        for run in self.runs.wanted.values():
            check_options(run)
        if self.config.simulator == "twin":
            for env in self.envs.values():
                backend.check_settings(env)
            check_contexts([*self.plan.test, *self.plan.seen])

    def jobs(self) -> list[Job]:
        """Return all jobs, seed by seed, so that a part of the benchmark already compares every entry."""
        jobs = [Job("evaluate", entry, 0) for entry in self.entries if not entry.seeded]
        for seed in range(self.config.seeds or 0):
            for entry in self.entries:
                if entry.kind == "trained":
                    jobs.append(Job("train", entry, seed))
                if entry.seeded and seed in self.config.seeds_of(entry):
                    jobs.append(Job("evaluate", entry, seed))
        return jobs

    def run(self) -> list[Summary]:
        """Do what is not done, write curves and summaries, and return a summary for each task.

        Raises:
            IzooError: something in the folder does not belong to this benchmark.
            KeyboardInterrupt: Ctrl-C; what was begun goes on at the next start.
        """
        check_settings(self.folder, to_mapping(self.config), MAY_DIFFER, MAY_GROW)
        with self.store.open():
            for contexts in self.tests.values():
                self.store.keep_contexts(contexts)
            if self.config.trained_in is not None:
                self.runs.take_over(Path(self.config.trained_in))
            self._do(self.jobs())
        self._draw_curves()
        return summaries(self.folder, self.store.table, self.tests)

    def _do(self, jobs: list[Job]) -> None:
        todo = [job for job in jobs if not self._is_done(job)]
        print(f"{len(jobs) - len(todo)} of {len(jobs)} jobs are done already. Results: {self.folder}", flush=True)
        with ParallelRuns(self.config.runs_at_once) as beside:
            for number, job in enumerate(todo):
                print(f"\n[{len(jobs) - len(todo) + number + 1}/{len(jobs)}] {job}", flush=True)
                if job.kind == "evaluate":
                    self._evaluate(job)
                elif self.config.runs_at_once == 1:
                    self.runs.train(job.key)
                else:
                    self.runs.train_beside(beside, [other.key for other in todo[number:] if other.kind == "train"])

    def _is_done(self, job: Job) -> bool:
        if job.kind == "train":
            return self.runs.is_trained(job.key)
        if job.entry.kind == "trained" and not self.runs.is_trained(job.key):
            return False
        self._admit(job)
        return not any(missing(self.store, plays, self.config.simulator) for plays in self._plays(job).values())

    def _admit(self, job: Job) -> Policy:
        """Tell the store which weights are tested, which drops rows of others, and return the policy."""
        entry, env = job.entry, self.envs[job.entry.name]
        known: dict[str, Any] = {}
        if entry.kind == "trained":
            path = selected(self.runs.run_dir(job.key), self.config.select)
            given: Any = run_folder.load_policy(path)
            known = {"source": os.path.relpath(path, self.folder), "frames": checkpoint.frames_of(path)}
        elif entry.kind == "untrained":
            given = untrained(train_config(self.config, self.plan, entry, job.seed))
        elif entry.floor_mps is not None:
            given = Glide(env, GlideConfig(floor_mps=entry.floor_mps))
        else:
            given = entry.policy
        named = as_policy(given, env, entry.name)
        if entry.seeded:
            known |= {"kind": entry.kind, "algo": entry.algo}
        self.store.admit({job.key: dataclasses.replace(named.record, **known)})
        return named.policy

    def _evaluate(self, job: Job) -> None:
        policy = self._admit(job)
        wants_best = self.config.select == "best" and job.entry.kind == "trained"
        if wants_best and checkpoint.best_of(self.runs.run_dir(job.key)) is None:
            print("The run was too short to be validated: its last weights are tested.", flush=True)
        for task, plays in self._plays(job).items():
            play_missing(
                self.store,
                plays,
                {job.key: policy},
                self.envs[job.entry.name],
                self.config.simulator,
                task=task,
                workers=self.config.num_workers or 0,
                cache=self.config.cache,
            )

    def _plays(self, job: Job) -> dict[str, list[Play]]:
        """Return what a job plays, by task."""
        return {
            task: [Play(*job.key, context, seed) for context in contexts for seed in self.plan.seeds.of(context)]
            for task, contexts in self.tests.items()
        }

    def _draw_curves(self) -> None:
        """Draw the learning curves of all training runs, where there are any."""
        curves: dict[str, list[MetricsTable]] = {}
        for name, seed in self.runs.wanted:
            table = MetricsTable.read(self.runs.run_dir((name, seed)) / run_folder.METRICS_FILE)
            curves.setdefault(name, []).append(table)
        if curves:
            compare_curves(curves, self.folder / CURVES_FILE, f"{self.plan.task}: training")
