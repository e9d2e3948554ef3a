"""A benchmark as a list of jobs over one results folder: what is done is skipped, what was begun goes on."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from izoo.benchmarks.claim import check_settings
from izoo.benchmarks.contestants import contestant
from izoo.benchmarks.generalization_options import Entry, GeneralizationConfig
from izoo.benchmarks.outcome import sum_up, write_submissions
from izoo.benchmarks.pace import Pace
from izoo.benchmarks.plan import Plan, evaluation_env, make_plan, train_config
from izoo.benchmarks.side_runs import SideRuns
from izoo.benchmarks.training_runs import Key, TrainingRuns, place
from izoo.conf.mapping import to_mapping
from izoo.console import duration
from izoo.contexts.context import Context
from izoo.envs.twin import twin_backend
from izoo.envs.twin.playable import check_contexts
from izoo.errors import IzooError
from izoo.evaluation import evaluate_policy
from izoo.evaluation.policies import HUMAN, UNCOMMANDED
from izoo.evaluation.provenance import versions
from izoo.evaluation.table import CSV_FILE, EPISODE_KEY, JOURNAL_FILE, MANIFEST_FILE, SUMMARY_FILE, read_csv
from izoo.files import claimed
from izoo.reporting.results import (
    EVALUATION_FOLDER,
    HUMAN_VEHICLES_FOLDER,
    TRAIN_FOLDER,
    EntryRecord,
    Results,
    RunRecord,
    read_results,
    with_run,
    write_results,
)
from izoo.training.collectors import check_collector


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
    """A benchmark and its folder.

    Args:
        config: resolved options.
        folder: the results folder.

    Raises:
        IzooError: the options name something that cannot be used.
    """

    def __init__(self, config: GeneralizationConfig, folder: Path) -> None:
        self.config, self.folder = config, folder
        self.entries = config.entries()
        self.plan: Plan = make_plan(config)
        self.envs = {entry.name: evaluation_env(config, entry) for entry in self.entries}
        # Composed before anything runs, so that an option that does not fit stops the benchmark at once.
        wanted = {
            (entry.name, seed): train_config(
                config, self.plan, entry, seed, folder / TRAIN_FOLDER / place(entry.name, seed)
            )
            for entry in self.entries
            if entry.kind == "trained"
            for seed in range(config.seeds or 0)
        }
        self.runs = TrainingRuns(
            wanted, folder / TRAIN_FOLDER, owes_validation=config.select == "best", begins=self._training_begins
        )
        self._check_simulators()
        self.versions = versions()
        if config.trained_in is not None:
            self.runs.take_from(Path(config.trained_in), self.versions)
        self.pace = Pace()
        self.results = self._index()

    def _check_simulators(self) -> None:
        """Raise :class:`IzooError` where a run or the twin cannot play what it shall, before anything is played."""
        for run in self.runs.wanted.values():
            check_collector(run)
        if self.config.simulator == "twin":
            for env in self.envs.values():
                twin_backend.check_settings(env)
            check_contexts(self.plan.test)

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

    @contextlib.contextmanager
    def open(self) -> Iterator[None]:
        """Claim the folder, check it against the options, and write the options into it.

        Raises:
            IzooError: the folder holds something else or another benchmark, or is in use.
        """
        with claimed(self.folder):
            check_settings(self.folder, to_mapping(self.config), self.versions)
            write_results(self.folder, self.results)
            yield

    def run(self, submit: bool = True) -> Results:
        """Do what is not done, and return the index of the folder.

        Args:
            submit: also write a leaderboard file per entry.

        Raises:
            IzooError: something in the folder does not belong to this benchmark.
            KeyboardInterrupt: Ctrl-C; what was begun goes on at the next start.
        """
        jobs = self.jobs()
        self.runs.take_over([job.key for job in jobs if job.kind == "train"])
        for job in jobs:
            self._refresh(job)
        todo = [job for job in jobs if not self._is_done(job)]
        print(f"{len(jobs) - len(todo)} of {len(jobs)} jobs are done already. Results: {self.folder}", flush=True)
        if todo and self.results.aggregates:
            self._set_aggregates({})  # a smaller benchmark's must not remain if this start is stopped before the end
        with SideRuns(self.config.runs_at_once) as beside:
            for number, job in enumerate(todo):
                left = self.pace.left([(self._pace_key(other), self._share(other)) for other in todo[number:]])
                done = len(jobs) - len(todo) + number
                wait = "time left unknown" if left is None else f"about {duration(left)} left"
                print(f"\n[{done + 1}/{len(jobs)}] {job}; {wait}", flush=True)
                if job.kind == "evaluate":
                    begin, work = time.monotonic(), self._work(job)
                    self._evaluate(job)
                    self.pace.add(self._pace_key(job), work, time.monotonic() - begin)
                elif self.config.runs_at_once == 1:
                    self.runs.train(job.key)
                else:
                    self.runs.train_beside(beside, [other.key for other in todo[number:] if other.kind == "train"])
                self._refresh(job)
        if todo or not self.results.aggregates:
            print("\nSumming up.", flush=True)
            aggregates = sum_up(self.folder, self.results)
            if submit:
                write_submissions(self.folder, self.results, self.plan, self.envs)
            self._set_aggregates(aggregates)  # last: with them the benchmark counts as ended
        return self.results

    def _set_aggregates(self, aggregates: dict[str, Any]) -> None:
        self.results = dataclasses.replace(self.results, aggregates=aggregates)
        write_results(self.folder, self.results)

    def _training_begins(self, key: Key, other_weights: bool) -> None:
        """Record a run that begins or goes on, and remove evaluations of weights that it will not have any more.

        These must not pass for evaluations of the weights that come.
        """
        job = Job("train", next(entry for entry in self.entries if entry.name == key[0]), key[1])
        if other_weights:
            for folder, _ in self._tests(job):
                shutil.rmtree(folder, ignore_errors=True)
        self._record(job, "training")

    def _evaluate(self, job: Job) -> None:
        env = self.envs[job.entry.name]
        policy = contestant(self.config, self.plan, env, job.entry, job.seed, self.runs.run_dir(job.key))
        for folder, contexts in self._tests(job):
            print(f"Evaluating in {len(contexts)} contexts, {len(self.plan.seeds)} seeds each.", flush=True)
            evaluate_policy(
                policy,
                contexts,
                self.plan.seeds,
                env,
                num_workers=self.config.num_workers or 0,
                out_dir=folder,
                name=job.entry.name,
                cache=self.config.cache,
                simulator=self.config.simulator,
            )

    def _tests(self, job: Job) -> list[tuple[Path, list[Context]]]:
        """Return the folders of a job's evaluations and the contexts that each of them plays."""
        test = self.plan.test
        tests = [(self.folder / EVALUATION_FOLDER / place(*job.key), test)]
        if self.config.human_vehicles:
            as_humans = [context.replace(cv_vehicle="human") for context in test]
            tests.append((self.folder / HUMAN_VEHICLES_FOLDER / place(*job.key), as_humans))
        return tests

    def _is_done(self, job: Job) -> bool:
        status = self._run_record(job).status
        return status == "done" or (job.kind == "train" and status == "trained")

    def _refresh(self, job: Job) -> None:
        """Bring the record of a job's run up to what is on the disk."""
        status = "waiting" if job.entry.kind == "trained" else "trained"
        frames, seconds = 0, 0.0
        if job.entry.kind == "trained":
            frames = self.runs.frames(job.key)
            if frames > 0:
                self.runs.check(job.key)
                seconds = self.runs.seconds(job.key)
                self.pace.add(self._pace_key(Job("train", job.entry, job.seed)), frames, seconds)
                status = "trained" if self.runs.is_trained(job.key) else "training"
        if status == "trained" and self._is_evaluated(job):
            status = "done"
        self._record(
            job, "waiting" if status == "trained" and job.entry.kind == "scripted" else status, frames, seconds
        )

    def _is_evaluated(self, job: Job) -> bool:
        """Whether the evaluations of a run hold every episode of the plan."""
        return all(self._is_whole(folder, contexts, job.entry.name) for folder, contexts in self._tests(job))

    def _is_whole(self, folder: Path, contexts: list[Context], entry: str) -> bool:
        whole = all((folder / name).is_file() for name in (CSV_FILE, MANIFEST_FILE, SUMMARY_FILE))
        if not whole or (folder / JOURNAL_FILE).exists():
            return False
        table: pd.DataFrame = read_csv(folder / CSV_FILE)
        there = set(table[list(EPISODE_KEY)].itertuples(index=False, name=None))
        names = {HUMAN, UNCOMMANDED, entry}
        return all((n, c.content_hash, s) in there for n in names for c in contexts for s in self.plan.seeds.of(c))

    def _run_record(self, job: Job) -> RunRecord:
        return next(run for run in self.results.entry(job.entry.name).runs if run.seed == job.seed)

    def _record(self, job: Job, status: str, frames: int | None = None, seconds: float | None = None) -> None:
        old = self._run_record(job)
        new = dataclasses.replace(
            old,
            status=status,
            frames=old.frames if frames is None else frames,
            seconds=old.seconds if seconds is None else seconds,
        )
        if new != old:
            self.results = with_run(self.results, job.entry.name, new)
            write_results(self.folder, self.results)

    def _index(self) -> Results:
        records = []
        for entry in self.entries:
            seeds = self.config.seeds_of(entry)
            made = [
                RunRecord(
                    seed=seed,
                    status="waiting",
                    evaluation=f"{EVALUATION_FOLDER}/{place(entry.name, seed)}",
                    run=f"{TRAIN_FOLDER}/{place(entry.name, seed)}" if entry.kind == "trained" else None,
                )
                for seed in seeds
            ]
            records.append(EntryRecord(entry.name, entry.kind, entry.algo, entry.action, tuple(made)))
        contexts = {
            "train": self.plan.train_text,
            "test": self.plan.test_text,
            "test_count": len(self.plan.test),
            "eval_seeds": len(self.plan.seeds),
        }
        settings = to_mapping(self.config)
        aggregates: dict = {}
        with contextlib.suppress(IzooError):  # a damaged index is made anew
            aggregates = read_results(self.folder).aggregates
        title, protocol, scale = self.plan.title, self.config.protocol, self.config.scale
        return Results(title, protocol, scale, settings, self.versions, contexts, tuple(records), False, aggregates)

    def _pace_key(self, job: Job) -> tuple[str, str]:
        return job.kind, job.entry.algo or job.entry.name

    def _work(self, job: Job) -> float:
        """Environment steps of what is left of a job."""
        if job.kind == "train":
            return float(self.runs.left(job.key))
        episodes = sum(len(contexts) for _, contexts in self._tests(job)) * len(self.plan.seeds)
        return float(episodes * self.envs[job.entry.name].decisions)

    def _share(self, job: Job) -> float:
        """Environment steps of what is left of a job, that no other job takes in at the same time."""
        return self._work(job) / (self.config.runs_at_once if job.kind == "train" else 1)
