"""Which parts of a learner help? Each is taken away or changed by itself, and compared on the same unseen approaches.

``python -m izoo.benchmarks.ablation`` trains every row of :data:`~izoo.benchmarks.ablation_options.ROWS` with several
seeds, one run after the other, and plays each policy on the twin: same contexts, same episode seeds for all rows, for
uncommanded CVs and for human drivers. It may be stopped at any time; the same command goes on.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from izoo.benchmarks.ablation_options import REFERENCE, ROWS, SETTING, AblationConfig
from izoo.commands.option_command import GOES_ON, OptionCommand

if TYPE_CHECKING:
    from tensordict.nn import TensorDictModuleBase

    from izoo.benchmarks.whole_episodes import Sums
    from izoo.conf.train_options import TrainConfig
    from izoo.contexts.context import Context
    from izoo.envs.config import EnvConfig

RESULT_FILE, FIGURE_FILE = "ablation.json", "ablation.png"
UNTRAINED, GLIDE, HUMAN, UNCOMMANDED = "untrained", "glide", "human", "uncommanded"
BESIDE = {
    UNTRAINED: "MAPPO before its first update",
    GLIDE: "glide, the scripted driver that is imitated",
    HUMAN: "human driving",
}
"""Rows that nobody trains."""
SUMS = ("demand_emission_g", "crossed")


def run(config: AblationConfig, given: frozenset[str] = frozenset()) -> dict[str, Any]:
    """Train and compare what is not there yet; print the table, and write it and its figure."""
    print("Loading torch; the twin compiles where it has not yet.", flush=True)
    from rich.console import Console

    from izoo.benchmarks.whole_episodes import WHOLE_DEMAND
    from izoo.errors import IzooError
    from izoo.files import claimed, write_json

    folder = Path(config.out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise IzooError(f"cannot make {folder}: {error.strerror}; choose another out.") from error
    with claimed(folder):
        bench = Bench(config, folder)
        bench.beside()
        for name in config.chosen:
            for seed in range(config.seeds):
                bench.trained(name, seed)
        found = summary(bench.entries, bench.places)
        write_json(folder / RESULT_FILE, {"setting": bench.about, "figures": WHOLE_DEMAND, "rows": found})
    draw(found, folder / FIGURE_FILE)
    Console().print(table(found))
    print(
        f"On the twin, {len(bench.contexts)} contexts, {config.eval_seeds} seeds each, not trained on. {WHOLE_DEMAND} "
        f"Brackets: 95 % intervals over contexts and training seeds. Result: {folder / RESULT_FILE}"
    )
    return {"rows": found}


class Bench:
    """The approaches that all are compared on, and what each driver did there.

    Args:
        config: options.
        folder: where runs and results lie.

    Attributes:
        entries: by row and training seed, CO2 of the whole demand in g and vehicles through, ``[contexts]`` each.
        about: what a result rests on, versions and code included; another one is refused in the same folder.
    """

    def __init__(self, config: AblationConfig, folder: Path) -> None:
        from izoo.benchmarks.claim import with_drivers
        from izoo.evaluation.provenance import versions
        from izoo.evaluation.selection import EpisodeSeeds, choose_contexts
        from izoo.training.validation import VALIDATION_SEED, held_out

        self.config, self.folder = config, folder
        base = self.options(REFERENCE, 0)
        contexts = held_out(base.contexts)
        self.contexts: list[Context] = choose_contexts(contexts, config.num_contexts, VALIDATION_SEED)
        seeds = EpisodeSeeds(VALIDATION_SEED, config.eval_seeds)
        self.plays = [(context, seed) for context in self.contexts for seed in seeds.of(context)]
        self.places = [context.intersection.name for context in self.contexts]
        self.about = {
            "train": [*SETTING, *config.train],
            "contexts": [context.content_hash for context in self.contexts],
            "eval_seeds": config.eval_seeds,
            "horizon_s": config.horizon_s,
            "simulator": "twin",
            "versions": with_drivers(versions()),
        }
        self.entries: dict[str, dict[int, dict[str, Any]]] = {}

    def options(self, name: str, seed: int) -> TrainConfig:
        """Return the options of a row's training run."""
        from izoo.conf.compose import compose_config
        from izoo.conf.train_options import TrainConfig

        threads = [] if self.config.threads is None else [f"twin.threads={self.config.threads}"]
        words = last_of([*SETTING, *ROWS[name].words, *self.config.train, *threads, f"seed={seed}"])
        start = ROWS[name].start
        if start is not None:
            words.append(f"start='{self.folder / 'runs' / start / f'seed{seed}'}'")
        run_dir = self.folder / "runs" / name / f"seed{seed}"
        return dataclasses.replace(compose_config("train", TrainConfig, words), run_dir=str(run_dir))

    def env(self, name: str = REFERENCE) -> EnvConfig:
        """Return the environment that a row's policies are compared in."""
        return dataclasses.replace(self.options(name, 0).env, horizon_s=self.config.horizon_s, emit=())

    def beside(self) -> None:
        """Play what nobody trains."""
        from izoo.benchmarks.contestants import untrained
        from izoo.benchmarks.whole_episodes import scripted
        from izoo.evaluation.baselines import baseline_context

        env = self.env()
        human = [(baseline_context(context), seed) for context, seed in self.plays]
        self._play(HUMAN, 0, lambda: self._played(env, scripted(HUMAN, env), human))
        self._play(UNCOMMANDED, 0, lambda: self._played(env, scripted(UNCOMMANDED, env)))
        self._play(GLIDE, 0, lambda: self._played(env, scripted(GLIDE, env)))
        for seed in range(self.config.seeds):
            policy = untrained(self.options(REFERENCE, seed))
            self._play(UNTRAINED, seed, lambda policy=policy: self._acted(env, policy))  # type: ignore[misc]

    def trained(self, name: str, seed: int) -> None:
        """Train a row with a seed, or go on with it, and compare its policy."""
        from izoo.training import checkpoint, runs
        from izoo.training.loop import train

        def work() -> dict[str, Any]:
            options = self.options(name, seed)
            run_dir, begin = Path(options.run_dir or ""), time.process_time()
            resumed = bool(checkpoint.listed(run_dir))
            if resumed:
                train(dataclasses.replace(options, resume=str(run_dir)), frozenset({"resume"}))
            else:
                shutil.rmtree(run_dir, ignore_errors=True)
                train(options)
            seconds = time.process_time() - begin
            found = self._acted(self.env(name), runs.load_policy(run_dir))
            return found if resumed else {**found, "train_cpu_s": round(seconds, 1)}  # of the rest alone it says little

        self._play(name, seed, work)
        if not self.config.keep_runs and name not in {row.start for row in ROWS.values()}:
            shutil.rmtree(self.folder / "runs" / name / f"seed{seed}", ignore_errors=True)

    def _acted(self, env: EnvConfig, policy: TensorDictModuleBase) -> dict[str, Any]:
        return self._played(env, lambda world: policy.eval())

    def _played(self, env: EnvConfig, make: Any, plays: Sequence[Any] | None = None) -> dict[str, Any]:
        from izoo.benchmarks.whole_episodes import played

        sums: Sums = played(plays or self.plays, env, self.config.threads, make)
        each = self.config.eval_seeds
        return {name: sums[name].reshape(-1, each).sum(1).round(3).tolist() for name in SUMS}

    def _play(self, name: str, seed: int, work: Any) -> None:
        """Do ``work`` unless its result lies there, and keep that."""
        from izoo.errors import IzooError
        from izoo.evaluation.folder import differences
        from izoo.files import write_json

        path = self.folder / "results" / f"{name}-seed{seed}.json"
        row = [*ROWS[name].words, f"start={ROWS[name].start}"] if name in ROWS else []
        about = json.loads(json.dumps({**self.about, "row": row}))
        if path.is_file():
            try:
                kept = json.loads(path.read_text())
                differing = differences(kept["about"], about)
            except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
                raise IzooError(f"cannot read {path}: {error}; remove it, and it is made anew.") from error
            if differing:
                raise IzooError(
                    f"{path} is the result of other settings or versions ({differing}); give those, or another out."
                )
        else:
            print(f"\n{name}, seed {seed}", flush=True)
            kept = {"about": about, **work()}
            path.parent.mkdir(exist_ok=True)
            write_json(path, kept)
        self.entries.setdefault(name, {})[seed] = {key: value for key, value in kept.items() if key != "about"}


def last_of(words: Sequence[str]) -> list[str]:
    """Return option words, of those that set the same one the last, where the first stood."""
    said = {word.partition("=")[0]: word for word in words}
    return list(said.values())


def summary(entries: Mapping[str, Mapping[int, Mapping[str, Any]]], places: Sequence[str]) -> dict[str, Any]:
    """Return every row's savings over uncommanded CVs and human driving, and its difference from the reference.

    Args:
        entries: by row and training seed: sums of CO2 and vehicles, per context. Contexts in which uncommanded CVs or
            human drivers burn nothing, or do not cross, have no savings and are left out for everybody.
        places: the intersection of every context.
    """
    import numpy as np

    from izoo.benchmarks.whole_episodes import per_vehicle_g
    from izoo.metrics.statistics import estimate, mean

    def sums(name: str, what: str) -> Any:
        return np.array([entry[what] for _, entry in sorted(entries[name].items())], float)

    def rates(name: str) -> Any:
        return per_vehicle_g(sums(name, "demand_emission_g"), through(name))

    def through(name: str) -> Any:
        return sums(name, "crossed")

    kept = np.logical_and.reduce([sums(name, what)[0] > 0 for name in (UNCOMMANDED, HUMAN) for what in SUMS])
    groups = [place for place, there in zip(places, kept, strict=True) if there]

    def figure(scores: Any) -> dict[str, Any]:
        return estimate(scores[:, kept], mean, groups).to_dict()

    with np.errstate(divide="ignore", invalid="ignore"):
        saved = {name: 1.0 - rates(name) / rates(UNCOMMANDED) for name in entries}
        found: dict[str, Any] = {}
        for name in [*BESIDE, *(row for row in ROWS if row in entries)]:
            label = BESIDE[name] if name in BESIDE else ROWS[name].label
            line: dict[str, Any] = {"label": label, "seeds": len(entries[name])}
            line["over_uncommanded"] = figure(saved[name])
            line["over_human"] = figure(1.0 - rates(name) / rates(HUMAN))
            line["through_over_uncommanded"] = figure(through(name) / through(UNCOMMANDED) - 1.0)
            line["per_seed"] = [float(row[kept].mean()) for row in saved[name]] if kept.any() else []
            if name not in BESIDE and name != REFERENCE and len(saved[name]) == len(saved[REFERENCE]):
                line["over_reference"] = figure(saved[name] - saved[REFERENCE])
            seconds = [entry["train_cpu_s"] for entry in entries[name].values() if "train_cpu_s" in entry]
            if seconds:
                line["train_cpu_s"] = round(sum(seconds) / len(seconds), 1)
            found[name] = line
    return found


def table(rows: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return the summary as a table to read."""
    from rich.table import Table

    from izoo.evaluation.show import percent

    shown = Table(title="Ablation")
    for heading in ("row", "seeds", "over uncommanded", "minus the reference", "through", "over human", "CPU s"):
        shown.add_column(heading, justify="left" if heading == "row" else "right")
    for line in rows.values():
        figures = [
            line.get(name) for name in ("over_uncommanded", "over_reference", "through_over_uncommanded", "over_human")
        ]
        cells = ["-" if figure is None else percent(figure) for figure in figures]
        shown.add_row(line["label"], str(line["seeds"]), *cells, f"{line.get('train_cpu_s', '')}")
    return shown


def draw(rows: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Save a picture of the savings over uncommanded CVs: means, 95 % intervals, and a tick for every training seed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from izoo.files import replacing

    shown = {name: line for name, line in rows.items() if name != HUMAN}
    figure = Figure(figsize=(8.0, 1.2 + 0.3 * len(shown)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for place, line in enumerate(reversed(shown.values())):
        estimate = line["over_uncommanded"]
        if estimate["low"] is not None:
            axes.plot([100 * estimate["low"], 100 * estimate["high"]], [place, place], color="tab:blue", linewidth=2)
        if estimate["value"] is not None:
            axes.plot(100 * estimate["value"], place, "o", color="tab:blue")
        if len(line["per_seed"]) > 1:
            seeds = [100 * value for value in line["per_seed"]]
            axes.plot(seeds, [place] * len(seeds), "|", color="tab:gray", markersize=9)
    axes.set_yticks(range(len(shown)), [line["label"] for line in reversed(shown.values())])
    axes.axvline(0.0, color="black", linewidth=0.8)
    axes.grid(axis="x", alpha=0.3)
    axes.set_xlabel("CO2 of the whole demand per vehicle that crosses, saved over uncommanded CVs, %")
    with replacing(path, durable=False) as partial:
        figure.savefig(partial, format="png", dpi=110)


COMMAND = OptionCommand(
    name="benchmarks.ablation",
    summary="Take parts of a learner away one by one, and compare what is left on approaches that nobody trained on.",
    examples=(
        "izoo.benchmarks.ablation out=ablation",
        "izoo.benchmarks.ablation rows=[no_kl,prioritised] seeds=4 out=ablation",
        "izoo.benchmarks.ablation rows=[td3,ddpg] seeds=1 num_contexts=6 'train=[\"total_frames=9600\"]' out=quick",
    ),
    config="izoo.benchmarks.ablation_options:AblationConfig",
    work="izoo.benchmarks.ablation:run",
    stopped=GOES_ON,
)
main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
