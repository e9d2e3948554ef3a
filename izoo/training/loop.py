"""A training run from its options to its last table."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from izoo.algos.learners.base import MASK
from izoo.conf.mapping import with_given
from izoo.conf.train_options import TrainConfig
from izoo.console import Progress, graceful_interrupt
from izoo.contexts.source import ContextSource, RandomSchedule, Schedule
from izoo.envs.mdp.frame import observation_names
from izoo.envs.twin_env import is_own_state
from izoo.errors import IzooError, UnfinishedError, check_whole
from izoo.files import NO_ROOM
from izoo.training import checkpoint, loggers, plots, run_folder
from izoo.training.baseline_episodes import BaselineComparison
from izoo.training.batch_statistics import READS, episode_stats
from izoo.training.collectors import BatchSource, SharedSchedule, ShiftedSchedule, check_collector, num_envs
from izoo.training.command_replay import EpisodeHistories
from izoo.training.environments import NUMBERS
from izoo.training.final_evaluation import compare
from izoo.training.learner import Learner, is_finite, learner_device
from izoo.training.prioritized_level_replay import Levels
from izoo.training.validation import Validator

MAX_LEARNER_THREADS = 8
PLOT_EVERY_S = 60.0
"""Seconds between two drawings of the learning curve while training: each takes half a second."""


Show = Callable[[dict[str, Any]], None]


def train(config: TrainConfig, given: frozenset[str] = frozenset(), show: Show | None = None) -> Path:
    """Train as ``config`` says and return the run folder.

    Args:
        config: the options.
        given: names of the options that were written on the command line; matters when resuming.
        show: called with the summary of the comparison that ends the run; ``None`` prints its verdict.

    Raises:
        IzooError: the options, or the run that is resumed, cannot be used; a new run leaves nothing behind.
        UnfinishedError: the run cannot go on, for lack of room on the disk or since its numbers are not finite any
            more; the message names the last good checkpoint.
        KeyboardInterrupt: after Ctrl-C, once the run is closed in good order.
    """
    if config.resume is not None:
        run_dir = _run_to_resume(config, given)
        with run_folder.owned(run_dir), _room(run_dir):
            config, state, path = _resumed(config, given, run_dir)
            session = Session(config, run_dir, config.contexts.build())
            if state is None:
                session.begin()
            else:
                session.restore(state, path)
            session.run(show)
        return run_dir
    # Contexts are read before the folder is made, so that bad input leaves nothing behind.
    learner_device(config.device)
    check_collector(config)
    source = config.contexts.build()
    with run_folder.created(config) as run_dir, _room(run_dir):
        session = Session(config, run_dir, source)
        session.begin()
        session.run(show)
    return run_dir


@contextlib.contextmanager
def _room(run_dir: Path) -> Iterator[None]:
    """Say in words that the folder of a run has gone, that nothing more can be written there, or that memory is short.

    Raises:
        UnfinishedError: so it is.
    """
    try:
        yield
    except OSError as error:
        if not run_dir.is_dir():
            raise UnfinishedError(f"{run_dir} is gone: it was removed or renamed while its run went on.") from error
        if error.errno not in NO_ROOM and not str(error.filename).startswith(str(run_dir)):
            raise
        raise UnfinishedError(f"cannot write to {run_dir}: {error.strerror}. {_last_good(run_dir)}") from error
    except (MemoryError, RuntimeError) as error:
        text = (str(error).splitlines() or ["out of memory"])[0]
        if isinstance(error, RuntimeError) and "allocate" not in text:  # what torch raises is of many names
            raise
        remedy = "give fewer rows, smaller networks or fewer agents"
        raise UnfinishedError(f"the memory does not suffice ({text}); {remedy}.") from error


def _last_good(run_dir: Path) -> str:
    """Return which checkpoint is the newest, and how to go on from there."""
    kept = checkpoint.listed(run_dir)
    if not kept:
        return "No checkpoint was saved; make room and train again."
    return f"The last good checkpoint is {kept[-1]}; make room, then go on: resume={run_dir}."


def _run_to_resume(config: TrainConfig, given: frozenset[str]) -> Path:
    """Return the folder of the run to go on with."""
    for name in sorted(given):
        if name.split(".")[0] not in run_folder.CHANGEABLE:
            raise IzooError(
                f"a resumed run keeps its own options, so {name} cannot be given with resume; "
                f"only these can: {', '.join(run_folder.CHANGEABLE)}."
            )
    where = Path(config.resume or "")
    return where if _has_only_begun(where) else checkpoint.run_of(checkpoint.find(where))


def _has_only_begun(where: Path) -> bool:
    """Whether a run has saved nothing yet."""
    return (where / run_folder.CONFIG_FILE).is_file() and not checkpoint.listed(where)


def _resumed(
    config: TrainConfig, given: frozenset[str], run_dir: Path
) -> tuple[TrainConfig, dict[str, Any] | None, Path]:
    """Return the options, the state and the checkpoint of the run to go on with; no state: it had not saved any yet."""
    where = Path(config.resume or "")
    path = None if _has_only_begun(where) else checkpoint.find(where)
    stored = run_folder.read_config(run_dir)
    run_folder.check_drivers(run_dir, stored)
    config = with_given(dataclasses.replace(stored, run_dir=str(run_dir)), config, given - {"resume"})
    state = None if path is None else checkpoint.load(path)
    if state is not None and path is not None:
        run_folder.check_state(state, stored, path)
        # The last batch of a run that is done may have gone beyond its frames.
        if config.total_frames < min(stored.total_frames, state["frames"]):
            raise IzooError(
                f"{path} has {state['frames']:,} frames already, more than total_frames={config.total_frames}; give "
                "more, or leave total_frames out."
            )
    learner_device(config.device)
    check_collector(config)
    run_folder.write_config(run_dir, config)
    return config, state, path or run_dir


class Session:
    """One stretch of a training run.

    Args:
        config: options of the run.
        run_dir: its folder.
        source: where its contexts come from.
    """

    def __init__(self, config: TrainConfig, run_dir: Path, source: ContextSource) -> None:
        torch.manual_seed(config.seed)
        self.config, self.run_dir, self.source = config, run_dir, source
        self.features, self._options = len(observation_names(config.env)), run_folder.options_digest(config)
        self.learner = Learner(config, learner_device(config.device))
        self.draws = RandomSchedule(source, config.seed)
        self.levels = Levels(self.draws, config.levels, config.seed) if config.levels.draw == "prioritised" else None
        self.frames = self.batches = self.episodes = 0
        self.seconds = 0.0
        self.histories, self.first_episode = EpisodeHistories.fresh(num_envs(config)), 0
        self._state: dict[str, Any] | None = None
        self._batches: BatchSource | None = None
        self._paired: BaselineComparison | None = None
        self._environments: dict[str, Any] = {}
        self._saved_at, self._forgets = -1, False
        self._plotted_s = 0.0
        self._threads = torch.get_num_threads()

    def begin(self) -> None:
        """Begin with the policy that the options name, if they name one."""
        if self.config.start is not None:
            run_folder.begin_with(self.learner.algorithm, self.config)
            self.learner.share()

    def restore(self, state: dict[str, Any], path: Path) -> None:
        """Go on from a checkpoint: with the weights and draws that it holds, and in the middle of its episodes.

        With another number of environments than before, the episodes in progress are left out.

        Args:
            state: of the checkpoint, checked (:func:`izoo.training.run_folder.check_state`).
            path: where it lies, for messages.
        """
        with run_folder.fitting(path):
            self.learner.load_state_dict(state)
            if self.levels is not None:
                self.levels.load_state_dict(state["levels"])
            environments, histories = state["environments"], EpisodeHistories.from_state(state["histories"])
        self.frames, self.batches, self.episodes = state["frames"], state["batches"], state["episodes"]
        self.seconds, self.first_episode = state["seconds"], state["first_episode"]
        self._state, self._saved_at, self._plotted_s = state, self.frames, self.seconds
        if environments:
            with run_folder.fitting(path):
                episodes = environments["episodes"]
                later = check_whole("next_episodes", max(environments["next_episodes"]), 0, 2**62)
            whole = len(episodes) == num_envs(self.config)
            if whole and is_own_state(environments):
                self._environments = environments
            else:
                self._forget_episodes(later)
                if whole:
                    print("Another user or version of izoo saved the episodes in progress, left out here.", flush=True)
        elif len(histories.histories) == len(self.histories.histories):
            self.histories = histories
        else:
            self._forget_episodes(histories.next_episode)
        print(f"Resuming {self.run_dir} at {self.frames:,} frames.", flush=True)

    def _forget_episodes(self, later: int) -> None:
        """Leave the episodes in progress out; ``later`` is the first that has not begun."""
        self._forgets = True
        if self.levels is not None:
            self.levels.forget_episodes()
        else:
            self.first_episode += later

    def run(self, show: Show | None = None) -> None:
        """Collect and learn until the frames are used up or Ctrl-C is pressed; then save, plot and evaluate.

        Args:
            show: called with the summary of the evaluation; ``None`` prints its verdict.

        Raises:
            UnfinishedError: the last weights could not be saved.
            KeyboardInterrupt: Ctrl-C was pressed; what was learned until then is saved.
        """
        self.table = loggers.MetricsTable(self.run_dir / run_folder.METRICS_FILE, self.frames)
        if len(self.table.rows) != self.batches:
            print(
                f"{self.table.path} has {len(self.table.rows)} rows for {self.batches} batches: it was damaged or cut. "
                "The run itself is whole; its curve is not.",
                file=sys.stderr,
                flush=True,
            )
        self.validator = Validator(self.config, self.run_dir, self.frames)
        sinks = loggers.make_sinks(self.config.logger, self.run_dir)
        print(f"Run folder: {self.run_dir}", flush=True)
        with graceful_interrupt() as interrupt:
            try:
                if self.frames < self.config.total_frames:
                    self._learn(interrupt, sinks)
                else:
                    print(f"All {self.frames:,} frames are there: nothing is left to train.", flush=True)
                    self._load(None)
                self._save()
                self._validate_last(interrupt, sinks)
                self._plot()
            finally:
                self.validator.close()
                loggers.close_all(sinks)
        if self.batches > 0 and self._saved_at != self.frames:
            raise UnfinishedError(f"the last weights could not be saved. {_last_good(self.run_dir)}")
        if interrupt.requested:
            self._say_where_it_stopped()
            raise KeyboardInterrupt
        found = self._compare()
        print(f"Run folder: {self.run_dir}", flush=True)
        if found and show is not None:
            show(found)
        elif found:
            print(found["verdict"], flush=True)

    def _say_where_it_stopped(self) -> None:
        if self.batches == 0:
            print("Stopped before the first batch; nothing is kept.", flush=True)
        elif self.frames < self.config.total_frames:
            done = f"Stopped at {self.frames:,} of {self.config.total_frames:,} frames"
            print(f"{done}; go on with: python -m izoo.train resume={self.run_dir}", flush=True)

    def _learn(self, interrupt: Any, sinks: list[loggers.Sink]) -> None:
        config = self.config
        going_on = self.histories.histories if self._state is not None else ()
        reads = self.learner.reads
        keeps = None if reads is None else (*reads, *READS)
        batches = BatchSource(config, self.learner.policy, self._schedule(), going_on, self._environments, keeps)
        self._batches = batches
        if config.simulator == "twin":
            if self.levels is None:
                self._paired = BaselineComparison(config, self._schedule())
            else:
                self._paired = BaselineComparison(config, self.draws, level=self.levels.level)
        try:
            self._load(batches)
            latest: dict[str, float] = {}
            with Progress(config.total_frames, self.frames) as bar:
                while self.frames < config.total_frames and not interrupt.requested:
                    row = {**self._batch(batches), **self.validator.poll()}
                    self.table.append(row)
                    loggers.log_all(sinks, row)
                    if "validation_frames" in row:  # an interval that it lacks must not be that of an earlier one
                        latest = {name: value for name, value in latest.items() if not name.startswith("validation_")}
                    latest |= row
                    bar.update(self.frames, loggers.in_short(latest))
                    if self.batches % config.checkpoint.every_batches == 0:
                        self._save()
                        if self.seconds - self._plotted_s >= PLOT_EVERY_S:
                            self._plot()
                    if self.validator.due(self.batches):
                        self._validate()
            self._environments = batches.environments()
        finally:
            self._batches = None
            batches.close()
            if self._paired is not None:
                self._paired.close()
                self._paired = None
            torch.set_num_threads(self._threads)

    def _validate(self) -> None:
        """Let the present weights be validated, if they could be saved."""
        self._save()
        if self._saved_at == self.frames:
            try:
                self.validator.submit(checkpoint.find(self.run_dir))
            except OSError as error:
                print(f"Could not begin a validation: {error}; training goes on.", file=sys.stderr, flush=True)

    def _validate_last(self, interrupt: Any, sinks: list[loggers.Sink]) -> None:
        """Validate the last weights, unless the run is to stop, was too short for any validation, or lost them."""
        every = self.config.validation.every_batches
        if self._saved_at != self.frames or interrupt.requested or every == 0 or self.batches < every:
            return
        if float(self.frames) not in self.validator.table.series("frames")[1]:
            self._validate()
        if self.validator.busy:
            print("Validating the last weights. Ctrl-C leaves that out.", flush=True)
        row = self.validator.wait(interrupt)
        if row:
            loggers.log_all(sinks, {"frames": self.frames, **row})

    def _load(self, batches: BatchSource | None) -> None:
        """Load what the checkpoint holds of the learner; only now, since making a collector tries the policy out."""
        if self._state is None:
            return
        self.learner.load_state_dict(self._state)
        if self._forgets and self.learner.decisions is not None:
            self.learner.decisions.open = None
        if batches is not None:
            batches.synchronise(self.learner.policy)
        self._state = None

    def _batch(self, batches: BatchSource) -> dict[str, float]:
        """Collect one batch, learn from it, and return its row of the table."""
        start = time.perf_counter()
        torch.set_num_threads(1)  # idle learner threads would spin on the simulators' cores
        batch = batches.next()
        collected = time.perf_counter()
        stats = episode_stats(batch, self.config.staggered)
        if self._paired is not None:
            self._paired.add(batch)
            stats |= self._paired.compare(batch)
        beside = time.perf_counter()
        torch.set_num_threads(min(self._threads, MAX_LEARNER_THREADS))
        if self.config.simulator == "sumo":
            self.histories.add(batch)
        learned = self.learner.update(batch, self.frames / self.config.total_frames)
        if self.levels is not None:
            learned |= self._score_levels(self.levels, batch)
        self._require_finite(learned)
        torch.set_num_threads(1)
        batches.synchronise(self.learner.policy)
        seconds = time.perf_counter() - start
        self.frames += batch.numel()
        self.batches += 1
        self.episodes += int(stats.pop("episodes"))
        self.seconds += seconds
        return {
            "frames": self.frames,
            "seconds": self.seconds,
            "frames_per_s": batch.numel() / seconds,
            "episodes": self.episodes,
            **stats,
            **learned,
            "collect_s": collected - start,
            **({} if self._paired is None else {"baseline_s": beside - collected}),
            "update_s": seconds - (beside - start),
        }

    def _score_levels(self, levels: Levels, batch: TensorDictBase) -> dict[str, float]:
        """Let a batch's advantages score what was played in it; return what to log."""
        numbers, done = batch.get(NUMBERS)[..., 0], batch.get(("next", "done")).squeeze(-1)
        levels.learn(numbers, self.learner.advantage(), batch.get(MASK), done)
        return levels.stats()

    def _require_finite(self, learned: Mapping[str, float]) -> None:
        """Raise :class:`UnfinishedError` where an update has left losses or weights that are no numbers any more."""
        bad = [name for name, value in learned.items() if name.startswith("loss") and not math.isfinite(value)]
        if not is_finite(self.learner.algorithm.policy.state_dict()):
            bad.append("the policy's weights")
        if bad:
            kept = checkpoint.listed(self.run_dir)
            raise UnfinishedError(
                f"training has diverged after {self.frames:,} frames: {', '.join(bad)} not finite. The last finite "
                f"checkpoint is {kept[-1] if kept else 'none'}; train again with a lower algo.lr, or smaller rewards."
            )

    def _schedule(self) -> Schedule:
        """Return the training episodes; other numbers of environments have played those that are left out."""
        if self.levels is not None:
            return self.levels
        schedule: Schedule = self.draws
        if self.first_episode:
            schedule = ShiftedSchedule(schedule, self.first_episode)
        blocks = self.config.algo.candidates
        return SharedSchedule(schedule, num_envs(self.config), blocks) if blocks > 1 else schedule

    def _save(self) -> None:
        if self._saved_at == self.frames or self.batches == 0:
            return
        state = {
            **self.learner.state_dict(),
            "features": self.features,
            "options": self._options,
            "batches": self.batches,
            "episodes": self.episodes,
            "seconds": self.seconds,
            "first_episode": self.first_episode,
            "histories": self.histories.state_dict(),
            "levels": {} if self.levels is None else self.levels.state_dict(),
            "environments": self._environments if self._batches is None else self._batches.environments(),
        }
        try:
            checkpoint.save(self.run_dir, self.frames, state, self.config.checkpoint.keep)
            self._saved_at = self.frames
        except OSError as error:
            kept = checkpoint.listed(self.run_dir)
            print(
                f"Could not save a checkpoint: {error}. The last good one is {kept[-1] if kept else 'none'}.",
                file=sys.stderr,
                flush=True,
            )

    def _plot(self) -> None:
        if self.table.rows:
            title = f"{self.config.algo.name}, {self.config.contexts.name}, seed {self.config.seed}"
            plots.learning_curve(self.table, self.run_dir / run_folder.CURVE_FILE, title, self.validator.table)
            self._plotted_s = self.seconds

    def _compare(self) -> dict[str, Any]:
        """Return the summary of the comparison with the baselines; empty where there is to be none."""
        if self.config.evaluation.contexts == 0 or self.batches == 0:
            return {}
        return compare(self.config, self.learner.policy, self.run_dir, self.source, self.frames)
