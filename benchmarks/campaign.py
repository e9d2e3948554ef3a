"""A benchmark as a list of jobs over one results folder: what is done is skipped, what was begun goes on."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from izoo.benchmarks.claim import check_run, check_settings, check_source, check_taken
from izoo.benchmarks.contestants import contestant
from izoo.benchmarks.generalization_options import Entry, GeneralizationConfig
from izoo.benchmarks.outcome import sum_up, write_submissions
from izoo.benchmarks.pace import Pace
from izoo.benchmarks.plan import Plan, evaluation_env, make_plan, train_config
from izoo.benchmarks.side_runs import Order, SideRuns
from izoo.conf.mapping import to_mapping
from izoo.conf.train_options import TrainConfig
from izoo.console import Progress, counted, duration
from izoo.contexts.context import Context
from izoo.envs.twin import twin_backend
from izoo.envs.twin.playable import check_contexts
from izoo.errors import IzooError
from izoo.evaluation import evaluate_policy
from izoo.evaluation.policies import HUMAN, UNCOMMANDED
from izoo.evaluation.provenance import versions
from izoo.evaluation.table import CSV_FILE, EPISODE_KEY, JOURNAL_FILE, MANIFEST_FILE, SUMMARY_FILE, read_csv
from izoo.files import claimed, replacing_folder
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
from izoo.training import checkpoint, runs
from izoo.training.collectors import check_collector
from izoo.training.loop import train
from izoo.training.records import MetricsTable

LOG_SUFFIX = ".log"
"""Of the file beside a run's folder that takes what it says, where it does not learn in this process."""
LOOK_EVERY_S = 1.0
"""How often runs in other processes are looked at."""


@dataclass(frozen=True)
class Job:
    """One training run or one evaluation."""

    kind: Literal["train", "evaluate"]
    entry: Entry
    seed: int

    @property
    def key(self) -> tuple[str, int]:
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
        self.runs: dict[tuple[str, int], TrainConfig] = {
            (entry.name, seed): train_config(
                config, self.plan, entry, seed, folder / TRAIN_FOLDER / _place(entry.name, seed)
            )
            for entry in self.entries
            if entry.kind == "trained"
            for seed in range(config.seeds or 0)
        }
        self._check_simulators()
        self.versions = versions()
        self.elsewhere = self._trained_elsewhere()
        self.pace = Pace()
        self.results = self._index()

    def _check_simulators(self) -> None:
        """Raise :class:`IzooError` where a run or the twin cannot play what it shall, before anything is played."""
        for run in self.runs.values():
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
        self._take_over(jobs)
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
                    self._train(job)
                else:
                    self._train_beside(beside, [other for other in todo[number:] if other.kind == "train"])
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

    def _train(self, job: Job) -> None:
        """Train a run, or the rest of it, in this process."""
        train(*self._begin(job))
        self._require_trained(job)

    def _train_beside(self, beside: SideRuns, jobs: Sequence[Job]) -> None:
        """Train the first of these runs, and those that come next, in processes of their own; wait for the first."""
        run_dirs = [self._run_dir(job) for job in jobs]
        total = sum(self.runs[job.key].total_frames for job in jobs)
        with Progress(total, sum(map(_learned, run_dirs))) as bar:
            while True:
                for job in jobs:
                    if beside.has_room and job.key not in beside:
                        log = self._run_dir(job).with_suffix(LOG_SUFFIX)
                        beside.begin(job.key, Order(*self._begin(job), log))
                if beside.is_done(jobs[0].key):
                    break
                bar.update(sum(map(_learned, run_dirs)), counted(len(beside.going), "run"))
                time.sleep(LOOK_EVERY_S)
        self._require_trained(jobs[0])

    def _begin(self, job: Job) -> tuple[TrainConfig, frozenset[str]]:
        """Return the options of a run that begins or goes on, and the names of those that count when it goes on."""
        self._record(job, "training")
        wanted, run_dir = self.runs[job.key], self._run_dir(job)
        if _frames(run_dir) == 0:
            self._clear(job)
            return wanted, frozenset()
        resumed = dataclasses.replace(wanted, resume=str(run_dir))
        return resumed, frozenset({"resume", "total_frames", "num_workers", "collector"})

    def _require_trained(self, job: Job) -> None:
        """Raise :class:`KeyboardInterrupt` where a run, or a validation that it owes, was stopped."""
        if not self._is_trained(job.key, self._run_dir(job)):
            raise KeyboardInterrupt

    def _clear(self, job: Job) -> None:
        """Remove a run that ended before its first checkpoint, and evaluations of weights that are gone.

        These must not pass for evaluations of the weights that come.
        """
        run_dir = self._run_dir(job)
        if run_dir.is_dir():
            with runs.owned(run_dir):  # where the process of a run outlives its benchmark, it is to be waited for
                shutil.rmtree(run_dir, ignore_errors=True)
        for folder, _ in self._tests(job):
            shutil.rmtree(folder, ignore_errors=True)

    def _trained_elsewhere(self) -> dict[tuple[str, int], Path]:
        """Return the finished runs of ``trained_in``, by entry and training seed; they are those that are wanted."""
        if self.config.trained_in is None:
            return {}
        source = Path(self.config.trained_in)
        check_source(source, self.versions)
        places = {key: source / TRAIN_FOLDER / _place(*key) for key in self.runs}
        found = {key: there for key, there in places.items() if self._is_trained(key, there)}
        for key, there in found.items():
            check_taken(there, self.runs[key])
        return found

    def _take_over(self, jobs: Sequence[Job]) -> None:
        """Copy the runs of ``trained_in`` that have not begun here."""
        begin = [job for job in jobs if job.kind == "train" and _frames(self._run_dir(job)) == 0]
        taken = [job for job in begin if job.key in self.elsewhere]
        for job in taken:
            self._clear(job)
            with replacing_folder(self._run_dir(job)) as partial:
                shutil.copytree(self.elsewhere[job.key], partial, dirs_exist_ok=True)
        if self.config.trained_in is not None:
            missing = [f"{job.entry.name} seed {job.seed}" for job in begin if job not in taken]
            still = f"; still to be trained: {', '.join(missing)}" if missing else ""
            print(f"{counted(len(taken), 'training run')} taken over from {self.config.trained_in}{still}.", flush=True)

    def _evaluate(self, job: Job) -> None:
        env, run_dir = self.envs[job.entry.name], self._run_dir(job)
        policy = contestant(self.config, self.plan, env, job.entry, job.seed, run_dir)
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
        place, test = _place(*job.key), self.plan.test
        tests = [(self._evaluation_dir(job), test)]
        if self.config.human_vehicles:
            tests.append(
                (self.folder / HUMAN_VEHICLES_FOLDER / place, [context.replace(cv_vehicle="human") for context in test])
            )
        return tests

    def _is_done(self, job: Job) -> bool:
        status = self._run_record(job).status
        return status == "done" or (job.kind == "train" and status == "trained")

    def _refresh(self, job: Job) -> None:
        """Bring the record of a job's run up to what is on the disk."""
        status = "waiting" if job.entry.kind == "trained" else "trained"
        frames, seconds = 0, 0.0
        if job.entry.kind == "trained":
            wanted = self.runs[job.key]
            run_dir = self._run_dir(job)
            frames = _frames(run_dir)
            if frames > 0:
                check_run(run_dir, wanted)
                seconds = _seconds(run_dir)
                self.pace.add(self._pace_key(Job("train", job.entry, job.seed)), frames, seconds)
                status = "trained" if self._is_trained(job.key, run_dir) else "training"
        if status == "trained" and self._is_evaluated(job):
            status = "done"
        self._record(
            job, "waiting" if status == "trained" and job.entry.kind == "scripted" else status, frames, seconds
        )

    def _is_trained(self, key: tuple[str, int], run_dir: Path) -> bool:
        """Whether a run has all its frames and, where validation chooses the weights, no validation is owed."""
        owed = self.config.select == "best" and bool(checkpoint.candidates(run_dir))
        return _frames(run_dir) >= self.runs[key].total_frames and not owed

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

    def _run_dir(self, job: Job) -> Path:
        return self.folder / TRAIN_FOLDER / _place(*job.key)

    def _evaluation_dir(self, job: Job) -> Path:
        return self.folder / EVALUATION_FOLDER / _place(*job.key)

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
                    evaluation=f"{EVALUATION_FOLDER}/{_place(entry.name, seed)}",
                    run=f"{TRAIN_FOLDER}/{_place(entry.name, seed)}" if entry.kind == "trained" else None,
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
            return max(self.runs[job.key].total_frames - _learned(self._run_dir(job)), 0)
        episodes = sum(len(contexts) for _, contexts in self._tests(job)) * len(self.plan.seeds)
        return float(episodes * self.envs[job.entry.name].decisions)

    def _share(self, job: Job) -> float:
        """Environment steps of what is left of a job, that no other job takes in at the same time."""
        return self._work(job) / (self.config.runs_at_once if job.kind == "train" else 1)


def _place(name: str, seed: int) -> str:
    """Return the folder of a training seed of an entry, relative to that of all."""
    return f"{name}/seed{seed}"


def _frames(run_dir: Path) -> int:
    """Frames of a run's newest checkpoint, 0 where there is none."""
    found = checkpoint.listed(run_dir)
    return int(found[-1].stem.rpartition("-")[2]) if found else 0


def _learned(run_dir: Path) -> int:
    """Frames that a run has learned from, so far."""
    frames, _ = MetricsTable.read(run_dir / runs.METRICS_FILE).series("seconds")
    return max(frames, default=0)


def _seconds(run_dir: Path) -> float:
    """Seconds that a run was trained for, so far."""
    _, seconds = MetricsTable.read(run_dir / runs.METRICS_FILE).series("seconds")
    return max(seconds, default=0.0)
