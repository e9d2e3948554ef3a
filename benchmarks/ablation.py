"""When should agents decide, what should be taken from their returns, and whom should they be paid for?

``python -m izoo.benchmarks.ablation`` trains every row of :data:`~izoo.benchmarks.campaign.ablation_options.ROWS`
with several
seeds, one run after the other, and plays each policy on the twin, in the same contexts with the same episode seeds. It
may be stopped at any time; the same command goes on.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from izoo.benchmarks.campaign.ablation_options import (
    BASELINES,
    REFERENCE,
    REWARDS,
    ROWS,
    SCOPES,
    SETTING,
    AblationConfig,
)
from izoo.cli.option_command import GOES_ON, OptionCommand

if TYPE_CHECKING:
    from izoo.conf.train_options import TrainConfig
    from izoo.envs.config import EnvConfig
    from izoo.metrics.summary import Summary
    from izoo.training.plots import Line

FIGURE_FILE = "ablation.png"
SHOWN = ("co2_saved", "delay_change_s")
"""Curves of the figure."""
TASK = "busy lane, not trained on"
UNTRAINED = "untrained"
SCRIPTED = ("human", "uncommanded", "cap_0.6", "glide")
"""Rows that are not trained."""
MAY_DIFFER, MAY_GROW = ("rows", "threads", "out", "verbose"), ("seeds", "eval_seeds")
MOST_ROWS = 6
"""Differences that are shown where not everything is asked for."""


def run(config: AblationConfig, given: frozenset[str] = frozenset()) -> Summary:
    """Train and compare what is not there yet; print the differences, and write summary and figure."""
    print("Loading torch; the twin compiles where it has not yet.", flush=True)

    from izoo.benchmarks.campaign.comparing import SUMMARY_FILE
    from izoo.files import write_json
    from izoo.metrics.summary import summarise
    from izoo.report import tables

    folder = Path(config.out)
    bench = Bench(config, folder)
    bench.play()
    summary = summarise(bench.table, reference=REFERENCE)
    write_json(folder / SUMMARY_FILE, [summary])
    draw_curves(bench, folder / FIGURE_FILE)
    if config.verbose:
        tables.print_summary(summary, verbose=True)
    largest = sorted(summary["pairwise"], key=lambda pair: -abs(pair["difference"]["value"] or 0.0))
    shown = largest if config.verbose else largest[:MOST_ROWS]
    tables.pairwise({**summary, "pairwise": shown}).show()
    print(f"{tables.counts(summary)} Results: {folder}")
    print(verdict(summary))
    return summary


class Bench:
    """The approaches that all rows are compared on, and the runs and rows of a folder.

    Args:
        config: options.
        folder: where runs and rows lie.
    """

    def __init__(self, config: AblationConfig, folder: Path) -> None:
        from izoo.benchmarks.campaign.training_runs import TrainingRuns
        from izoo.results.selection import EpisodeSeeds, choose_contexts
        from izoo.results.store import Store
        from izoo.training.validation_rollout import VALIDATION_SEED, held_out

        self.config, self.folder = config, folder
        source = held_out(self.options(REFERENCE, 0).contexts)
        seeds = EpisodeSeeds(VALIDATION_SEED, config.eval_seeds)
        contexts = choose_contexts(source, config.num_contexts, VALIDATION_SEED)
        self.episodes = [(context, seed) for context in contexts for seed in seeds.of(context)]
        keys = [(name, seed) for name in config.chosen for seed in range(config.seeds)]
        self.runs = TrainingRuns({key: self.options(*key) for key in keys}, folder)
        self.store = Store(folder, task=TASK, config=self.env())

    @property
    def table(self) -> Any:
        """The rows of what is compared now; the folder may hold others."""
        table = self.store.table
        return table[table["policy"].isin([*SCRIPTED, UNTRAINED, *self.config.chosen])]

    def options(self, name: str, seed: int) -> TrainConfig:
        """Return the options of a row's training run."""
        return dataclasses.replace(self._of_row(name), seed=seed)

    @functools.cache  # noqa: B019 - a bench lives as long as its command
    def _of_row(self, name: str) -> TrainConfig:
        from izoo.cli.compose import compose_config
        from izoo.conf.train_options import TrainConfig

        threads = [] if self.config.threads is None else [f"twin.threads={self.config.threads}"]
        words = last_of([*SETTING, *ROWS[name].words, *self.config.train, *threads])
        return compose_config(TrainConfig, words)

    def env(self, name: str = REFERENCE) -> EnvConfig:
        """Return the environment that a row's policies are compared in."""
        from izoo.results.rollout import evaluated

        env = self.options(name if name in ROWS else REFERENCE, 0).env
        env = env.with_accelerations() if name in SCRIPTED else env
        return evaluated(dataclasses.replace(env, horizon_s=self.config.horizon_s, emit=()))

    def play(self) -> None:
        """Train and play what the folder lacks."""
        from izoo.benchmarks.campaign.comparing import check_settings
        from izoo.benchmarks.campaign.policies import untrained
        from izoo.conf.mapping import to_mapping
        from izoo.training import checkpoint, run_folder

        check_settings(self.folder, to_mapping(self.config), MAY_DIFFER, MAY_GROW)
        with self.store.open():
            self.store.keep_contexts(context for context, _ in self.episodes)
            for name in SCRIPTED:
                self._play(name, 0, name)
            for seed in range(self.config.seeds):
                self._play(UNTRAINED, seed, untrained(self.options(REFERENCE, seed)), kind="untrained")
            for key in self.runs.wanted:
                if not self.runs.is_trained(key):
                    print(f"\n{key[0]}, seed {key[1]}", flush=True)
                    self.runs.train(key)
                path = checkpoint.find(self.runs.run_dir(key))
                known: dict[str, Any] = {"algo": self.runs.wanted[key].algo.name, "frames": checkpoint.frames_of(path)}
                self._play(key[0], key[1], run_folder.load_policy(path), kind="trained", **known)

    def _play(self, name: str, seed: int, given: Any, **known: Any) -> None:
        from izoo.cores import usable_cores
        from izoo.results.rollout import play_policy

        env = self.env(name)
        own: dict[str, Any] = {"name": name, "train_seed": seed, "known": known}
        workers = self.config.threads or usable_cores()
        play_policy(self.store, given, self.episodes, env, "twin", task=TASK, workers=workers, **own)


def draw_curves(bench: Bench, path: Path) -> None:
    """Draw what was saved against decisions: a panel per reward and figure, a line per scope and baseline."""
    from izoo.training import plots

    charts = []
    for (reward, (said, _)), column in itertools.product(REWARDS.items(), SHOWN):
        series = []
        for name in (name for name in bench.config.chosen if name.endswith(reward)):
            scope, baseline, _ = name.split("-")
            colour = plots.PALETTE[list(SCOPES).index(scope)]
            dash = ("-", "--", ":")[list(BASELINES).index(baseline)]
            label = f"{SCOPES[scope][0]}, {BASELINES[baseline][0]}"
            lines = [curve(bench.runs.run_dir(key), column) for key in bench.runs.wanted if key[0] == name]
            between = plots.band(lines)
            if between is not None:
                x, lowest, mean, highest = between
                series.append(plots.Series(x, mean, label, "band", lowest, highest, colour))
                lines = [(x, mean)]
            series += [plots.Series(x, y, label, colour=colour, dash=dash) for x, y in lines]
        if series:
            title = "CO2 saved (%)" if column == SHOWN[0] else "added delay (s)"
            charts.append(plots.Chart(f"{column}-{reward}", f"{title}, {said}", series, "decisions"))
    plots.save(plots.draw(charts, columns=2), path)


def curve(run_dir: Path, column: str) -> Line:
    """Return a column of a run's validations, and the decisions that it had learned from by then."""
    from izoo.training.loggers import MetricsTable
    from izoo.training.run_folder import METRICS_FILE
    from izoo.training.validation import VALIDATION_FILE

    measured, validated = (MetricsTable.read(run_dir / name) for name in (METRICS_FILE, VALIDATION_FILE))
    frames, rows = measured.series("agent_rows")
    at, values = validated.series(column)
    return np.interp(at, frames, np.cumsum(rows)), np.array(values)


def last_of(words: Sequence[str]) -> list[str]:
    """Return option words, of those that set the same one the last, where the first stood."""
    said = {word.partition("=")[0]: word for word in words}
    return list(said.values())


def verdict(summary: Mapping[str, Any]) -> str:
    """Say in one sentence which rows are told apart from the reference."""
    rows = [pair for pair in summary["pairwise"] if pair["x"] in ROWS]
    apart = [pair for pair in rows if pair["verdict"] != "indistinguishable"]
    words = ", ".join(f"{pair['x']} ({pair['difference']['value']:+.1f} points)" for pair in apart)
    of = f"{len(apart)} of {len(rows)} rows"
    return f"{of} {'is' if len(apart) == 1 else 'are'} told apart from {REFERENCE!r}{': ' if words else ''}{words}."


COMMAND = OptionCommand(
    name="benchmarks.ablation",
    summary="Compare when CVs decide, the baseline of their returns and their reward, on approaches not trained on.",
    examples=(
        "izoo.benchmarks.ablation out=ablation",
        "izoo.benchmarks.ablation rows=[every_8_s-paired-own,per_vehicle-learned-own] out=ablation",
        "izoo.benchmarks.ablation rows=[every_2_s-paired-own] seeds=1 num_contexts=6 'train=[\"total_frames=9600\"]'",
    ),
    config="izoo.benchmarks.campaign.ablation_options:AblationConfig",
    work="izoo.benchmarks.ablation:run",
    stopped=GOES_ON,
)
main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
