"""A training run from its options to its last table, new or resumed: collect, learn, save, validate, evaluate."""

from __future__ import annotations

import contextlib
import math
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from izoo.algos.learners.base import EPISODES, MASK
from izoo.algos.learners.registry import make_algorithm
from izoo.conf.train_options import CHANGEABLE, TrainConfig
from izoo.console import Interrupt, Progress, graceful_interrupt
from izoo.envs import simulator_of
from izoo.errors import IzooError, UnfinishedError
from izoo.files import NO_ROOM
from izoo.metrics.summary import summarise
from izoo.options import to_mapping
from izoo.processes import processor_s
from izoo.results.rollout import evaluate_policy
from izoo.results.selection import EVALUATION_STREAM, EpisodeSeeds, choose_contexts, describe
from izoo.results.store import PolicyRecord, check_same
from izoo.training import checkpoint, loggers, plots, run_folder
from izoo.training.baseline_episodes import BaselineComparison
from izoo.training.batch_statistics import READS, episode_stats, unused_slots
from izoo.training.collectors import BatchSource
from izoo.training.learner import Learner, learner_device
from izoo.training.loggers import IMITATION
from izoo.training.option_checks import check_options
from izoo.training.prioritized_level_replay import PrioritizedLevelReplay
from izoo.training.run_state import RunState
from izoo.training.validation import Validator

MAX_LEARNER_THREADS = 8
PLOT_EVERY_S = 60.0
"""Seconds between two drawings of the learning curve while training: each takes half a second."""
Show = Callable[[dict[str, Any]], None]


def train(config: TrainConfig, show: Show | None = None) -> Path:
    """Train as ``config`` says and return the run folder.

    Args:
        config: the options; of a run that is resumed, those of :func:`izoo.training.run_folder.resumed`.
        show: called with the summary of the final evaluation; ``None`` prints its verdict.

    Raises:
        IzooError: the options, or the run that is resumed, cannot be used; a new run leaves nothing behind.
        UnfinishedError: the run cannot go on: the disk or the memory is full, or its numbers are not finite any more;
            the message names the last good checkpoint.
        KeyboardInterrupt: after Ctrl-C or SIGTERM, once the run is saved.
    """
    check_options(config)
    # Contexts are read before the folder is made, so that bad input leaves nothing behind.
    source = config.contexts.build()
    if config.resume is None:
        path, folder = None, run_folder.created(config)
    else:
        run_dir, path = run_folder.resume_point(Path(config.resume))
        folder = run_folder.owned(run_dir)
    with folder as run_dir, _room(run_dir):
        state = None if config.resume is None else _to_resume(config, run_dir, path)
        torch.manual_seed(config.seed)
        device = learner_device(config.device)
        algorithm = make_algorithm(config.algo, config.action, config.env, device)
        run = RunState(config, source, Learner(algorithm, config, device))
        if path is not None and state is not None:
            run.restore(state, path)
            print(f"Resuming {run_dir} at {run.frames:,} frames.", flush=True)
        elif config.start is not None:
            run_folder.start_from(algorithm, config)
            run.learner.share()
        Session(run, run_dir).run(show)
    return run_dir


@contextlib.contextmanager
def _room(run_dir: Path) -> Iterator[None]:
    """Say in one sentence that the disk is full, or that memory is short.

    Raises:
        UnfinishedError: so it is.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in NO_ROOM and not str(error.filename).startswith(str(run_dir)):
            raise
        raise UnfinishedError(f"cannot write to {run_dir}: {error.strerror}. {last_good(run_dir)}") from error
    except (MemoryError, RuntimeError) as error:
        text = (str(error).splitlines() or ["out of memory"])[0]
        if isinstance(error, RuntimeError) and "allocate" not in text:  # torch has many errors for it
            raise
        remedy = "give fewer rows, smaller networks or fewer agents"
        raise UnfinishedError(f"the memory does not suffice ({text}); {remedy}.") from error


def _to_resume(config: TrainConfig, run_dir: Path, path: Path | None) -> dict[str, Any] | None:
    """Check and write the options with which a run goes on, and return the state of its checkpoint."""
    stored = run_folder.read_config(run_dir)
    own, given = (
        {name: value for name, value in to_mapping(each).items() if name not in (*CHANGEABLE, "run_dir")}
        for each in (stored, config)
    )
    check_same(own, given, f"a resumed run keeps its options (run_folder.resumed gives them), but {run_dir} was begun")
    state = None if path is None else checkpoint.load(path)
    # The last batch of a run that is done may have gone beyond its frames.
    if state is not None and config.total_frames < min(stored.total_frames, state["frames"]):
        raise IzooError(
            f"{path} has {state['frames']:,} frames already, more than total_frames={config.total_frames}; give more, "
            "or leave total_frames out."
        )
    run_folder.write_config(run_dir, config)
    return state


def last_good(run_dir: Path) -> str:
    """Return which checkpoint is the newest, and how to go on from there."""
    if not run_dir.is_dir():
        return "The run's folder was removed while it trained; train again."
    kept = checkpoint.listed(run_dir)
    if not kept:
        return "No checkpoint was saved; make room and train again."
    return f"The last good checkpoint is {kept[-1]}; make room, then go on: resume={run_dir}."


class DivergedError(UnfinishedError):
    """Losses or weights are not finite any more."""


class Session:
    """One stretch of a training run.

    Args:
        state: where the run stands.
        run_dir: its folder.
    """

    def __init__(self, state: RunState, run_dir: Path) -> None:
        self.state, self.config, self.run_dir = state, state.config, run_dir
        self._batches: BatchSource | None = None
        self._baselines: BaselineComparison | None = None
        self._saved_at = state.frames if state.frames else -1
        self._abandoned = [path for path in checkpoint.listed(run_dir) if checkpoint.frames_of(path) > state.frames]
        self._plotted_s, self._worked_s = state.seconds, 0.0
        self._threads = torch.get_num_threads()

    def run(self, show: Show | None = None) -> None:
        """Collect and learn until the frames are used up or the run is interrupted; then save, plot and evaluate.

        Args:
            show: called with the summary of the evaluation; ``None`` prints its verdict.

        Raises:
            UnfinishedError: the last weights could not be saved.
            KeyboardInterrupt: the run was interrupted; what was learned until then is saved.
        """
        self.table = loggers.MetricsTable(self.run_dir / run_folder.METRICS_FILE, self.state.frames)
        self.validator = Validator(self.config, self.run_dir, self.state.frames)
        self.sinks = loggers.make_sinks(self.config.logger, self.run_dir)
        print(f"Run folder: {self.run_dir}", flush=True)
        with graceful_interrupt() as interrupt:
            try:
                if self.state.frames < self.config.total_frames:
                    self._learn(interrupt)
                else:
                    print(f"All {self.state.frames:,} frames are there: nothing is left to train.", flush=True)
                    self.state.load(None)
                    checkpoint.remove(self._abandoned)
                self._save()
                if words := unused_slots(self.table.series("most_agents")[1], self.config.env.num_agents):
                    print(words, flush=True)
                self._validate_last(interrupt)
                self._plot()
            finally:
                self.validator.close()
                loggers.close_all(self.sinks)
        if self.state.batches > 0 and self._saved_at != self.state.frames:
            raise UnfinishedError(f"the last weights could not be saved. {last_good(self.run_dir)}")
        if interrupt.requested:
            self._say_where_it_stopped()
            raise KeyboardInterrupt
        self._evaluate(show)

    def _say_where_it_stopped(self) -> None:
        if self.state.batches == 0:
            print("Stopped before the first batch; nothing is kept.", flush=True)
        elif self.state.frames < self.config.total_frames:
            done = f"Stopped at {self.state.frames:,} of {self.config.total_frames:,} frames"
            print(f"{done}; go on with: python -m izoo.train resume={self.run_dir}", flush=True)

    def _learn(self, interrupt: Interrupt) -> None:
        """Collect and learn, batch after batch."""
        self._worked_s = processor_s()
        state, reads = self.state, self.state.learner.reads
        keeps = None if reads is None else (*reads, *READS)
        episodes, begun = state.schedule(), state.in_progress()
        batches = self._batches = BatchSource(
            self.config, state.learner.policy, episodes, begun, state.environments, keeps
        )
        batched = simulator_of(self.config.simulator).batched
        try:
            if batched and state.levels is not None:
                self._baselines = BaselineComparison(self.config, state.draws, level=state.levels.level)
            elif batched:
                self._baselines = BaselineComparison(self.config, episodes)
            if self._baselines is not None:
                self._baselines.expect(state.environments.get("episodes", ()))
            self.state.load(batches)
            self._learn_from(batches, interrupt)
            state.environments = batches.environments()
        except UnfinishedError as error:  # a signal to the whole job may have ended the processes that collect, too
            if isinstance(error, DivergedError) or not interrupt.requested:
                raise
        finally:
            self._batches, baselines, self._baselines = None, self._baselines, None
            with contextlib.nullcontext() if baselines is None else contextlib.closing(baselines):
                batches.close()
            torch.set_num_threads(self._threads)

    def _learn_from(self, batches: BatchSource, interrupt: Interrupt) -> None:
        latest: dict[str, float] = {}
        with Progress(self.config.total_frames, self.state.frames) as bar:
            while self.state.frames < self.config.total_frames and not interrupt.requested:
                row = {**self._batch(batches), **self.validator.poll()}
                self.table.append(row)
                loggers.log_all(self.sinks, row)
                if "validation_frames" in row:  # an interval that it lacks must not be that of an earlier one
                    latest = {name: value for name, value in latest.items() if not name.startswith("validation_")}
                latest.pop(IMITATION, None)  # shown only while it lasts
                latest |= row
                bar.update(self.state.frames, loggers.in_short(latest))
                if self.state.batches % self.config.checkpoint.every_batches == 0:
                    self._save()
                    if self.state.seconds - self._plotted_s >= PLOT_EVERY_S:
                        self._plot()
                if self.validator.due(self.state.batches):
                    self._validate()

    def _batch(self, batches: BatchSource) -> dict[str, float]:
        """Collect one batch, learn from it, and return its row of the table."""
        start = time.perf_counter()
        torch.set_num_threads(1)  # idle learner threads would spin on the simulators' cores
        batch = batches.next()
        collected = time.perf_counter()
        stats = episode_stats(batch, self.config.staggered)
        if self._baselines is not None:
            self._baselines.add(batch)
            stats |= self._baselines.compare(batch)
        compared = time.perf_counter()
        torch.set_num_threads(min(self._threads, MAX_LEARNER_THREADS))
        if not simulator_of(self.config.simulator).batched:
            self.state.histories.add(batch)
        learned = self.state.learner.update(batch, self.state.frames / self.config.total_frames)
        if self.state.levels is not None:
            learned |= self._score_levels(self.state.levels, batch)
        self._require_finite(learned)
        torch.set_num_threads(1)
        try:
            batches.synchronise(self.state.learner.policy)
        finally:  # what was learned counts, and can be saved
            seconds = time.perf_counter() - start
            self.state.frames += batch.numel()
            self.state.batches += 1
            self.state.episodes += int(stats.pop("episodes"))
            self.state.seconds += seconds
        worked_s, self._worked_s = self._worked_s, processor_s()
        return {
            "frames": self.state.frames,
            "seconds": self.state.seconds,
            "processor_s": self._worked_s - worked_s,
            "frames_per_s": batch.numel() / seconds,
            "episodes": self.state.episodes,
            **stats,
            **learned,
            "collect_s": collected - start,
            **({} if self._baselines is None else {"baseline_s": compared - collected}),
            "update_s": seconds - (compared - start),
        }

    def _score_levels(self, levels: PrioritizedLevelReplay, batch: TensorDictBase) -> dict[str, float]:
        """Let a batch's advantages score the levels that were played in it; return what to log."""
        numbers, done = batch.get(EPISODES)[..., 0], batch.get(("next", "done")).squeeze(-1)
        levels.update(numbers, self.state.learner.advantage(), batch.get(MASK), done)
        return levels.stats()

    def _require_finite(self, learned: Mapping[str, float]) -> None:
        """Raise :class:`DivergedError` where an update has left losses or weights that are not finite."""
        bad = [name for name, value in learned.items() if name.startswith("loss") and not math.isfinite(value)]
        weights = self.state.learner.algorithm.policy.state_dict().values()
        if not all(value.isfinite().all() for value in weights if torch.is_tensor(value)):
            bad.append("the policy's weights")
        if bad:
            kept = checkpoint.listed(self.run_dir)
            raise DivergedError(
                f"training has diverged after {self.state.frames:,} frames: {', '.join(bad)} not finite. The last "
                f"finite checkpoint is {kept[-1] if kept else 'none'}; train again with a lower algo.lr, or smaller "
                "rewards."
            )

    def _save(self) -> None:
        if self._saved_at == self.state.frames or self.state.batches == 0:
            return
        if self._batches is not None:
            self.state.environments = self._batches.environments()
        try:
            state, keep = self.state.state_dict(), self.config.checkpoint.keep
            checkpoint.save(self.run_dir, self.state.frames, state, keep, self._abandoned)
            self._saved_at, self._abandoned = self.state.frames, []
        except OSError as error:
            print(f"Could not save a checkpoint: {error}. {last_good(self.run_dir)}", file=sys.stderr, flush=True)

    def _validate(self) -> None:
        """Let the present weights be validated, if they could be saved."""
        self._save()
        if self._saved_at == self.state.frames:
            try:
                self.validator.submit(checkpoint.find(self.run_dir))
            except OSError as error:
                print(f"Could not begin a validation: {error}; training goes on.", file=sys.stderr, flush=True)

    def _validate_last(self, interrupt: Interrupt) -> None:
        """Validate the last weights, unless the run was interrupted, was too short for any validation, or lost them."""
        every = self.config.validation.every_batches
        if self._saved_at != self.state.frames or interrupt.requested or every == 0 or self.state.batches < every:
            return
        if float(self.state.frames) not in self.validator.table.series("frames")[1]:
            self._validate()
        if self.validator.busy:
            print("Validating the last weights. Ctrl-C leaves that out.", flush=True)
        row = self.validator.wait(interrupt)
        if row:
            loggers.log_all(self.sinks, {"frames": self.state.frames, **row})

    def _plot(self) -> None:
        if self.table.rows:
            title = f"{self.config.algo.name}, {self.config.contexts.name}, seed {self.config.seed}"
            plots.learning_curve(self.table, self.run_dir / run_folder.CURVE_FILE, title, self.validator.table)
            self._plotted_s = self.state.seconds

    def _evaluate(self, show: Show | None) -> None:
        """Compare the policy with the baselines in SUMO, if the options ask for it, and show the summary.

        Episodes are as long as those of training; what an earlier comparison left is replaced.
        """
        config, options, found = self.config, self.config.evaluation, None
        if options.contexts > 0 and self.state.batches > 0:
            contexts = choose_contexts(self.state.source, options.contexts, config.seed)
            seeds = EpisodeSeeds(config.seed + EVALUATION_STREAM, options.seeds)
            print(f"Comparing with human driving: {describe(contexts, seeds, config.env)}.", flush=True)
            folder = self.run_dir / run_folder.EVALUATIONS / run_folder.LAST
            shutil.rmtree(folder, ignore_errors=True)
            source, name = str(checkpoint.find(self.run_dir)), config.algo.name
            table = evaluate_policy(
                self.state.learner.policy,
                contexts,
                seeds,
                config.env,
                name=name,
                train_seed=config.seed,
                workers=config.num_workers,
                out=folder,
                record=PolicyRecord("trained", None, source, name, self.state.frames),
            )
            found = summarise(table)
        print(f"Run folder: {self.run_dir}", flush=True)
        if found is not None:
            (show or (lambda summary: print(summary["verdict"], flush=True)))(found)
