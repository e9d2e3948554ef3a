"""``python -m izoo.benchmarks.campaign experiment=reference out=FOLDER``: train, play and compare what a file lists.

It may be stopped at any time; the same command goes on. It leaves a folder per part of the experiment, and all tables::

    FOLDER/
      tables.md                all tables, in Markdown, and what is still missing
      PART/
        rows.csv, manifest.json, contexts.json.gz   what was played (izoo.results.store)
        summary.json           figures of every task that was tested (izoo.metrics.summary)
        learning.csv           what training runs had cost and saved at each validation
        saved.png, curves.png  what entries saved; what learning.csv says
        train/ENTRY/seedK/     run folders of izoo.train
        leaderboard/ENTRY.json leaderboard files (izoo.report.leaderboard) of entries that lack nothing
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from izoo.cli.option_command import GOES_ON, OptionCommand
from izoo.files import make_absolute
from izoo.options import CheckedOptions

TABLES_FILE = "tables.md"


@dataclass(frozen=True)
class CampaignConfig(CheckedOptions):
    """Options of a campaign.

    Attributes:
        experiment: one that ships (``reference``, ``ablation``, ``tradeoffs``, ``smoke``), or a YAML file.
        out: folder of the results; null: ``results/EXPERIMENT`` in the current folder.
        parts: which parts to do, in their order in the experiment; empty: all.
        play: train and play what is missing; false: sum up what is there, and say what is missing.
        dataset: folder of the measured intersections, for parts whose task needs it; without it they are not played.
        threads: of the twin; null: one per core.
        num_workers: processes that play SUMO; 0: this one.
        runs_at_once: training runs that learn at the same time, each in a process on its share of the cores.
        cache: folder of the cached episodes of human and uncommanded driving; null: the user's cache folder.
        verbose: print all tables, not only the headlines.
    """

    experiment: str = "smoke"
    out: str | None = None
    parts: tuple[str, ...] = ()
    play: bool = True
    dataset: str | None = None
    threads: int | None = None
    num_workers: int = 2
    runs_at_once: int = 1
    cache: str | None = None
    verbose: bool = False
    ranges = (("num_workers", 0, 1024), ("runs_at_once threads", 1, 1024))

    def __post_init__(self) -> None:
        super().__post_init__()
        make_absolute(self, "out", "dataset", "cache")


def run(config: CampaignConfig) -> Path:
    """Do what is missing, sum up, and return the campaign's folder."""
    print("Loading torch; the twin compiles where it has not yet.", flush=True)
    from izoo.benchmarks.campaign import summing_up
    from izoo.benchmarks.campaign.experiment import read_experiment
    from izoo.benchmarks.campaign.jobs import PartRun, reads_folder
    from izoo.benchmarks.campaign.learning_curves import update_learning
    from izoo.errors import unknown_choice
    from izoo.files import write_text
    from izoo.report.tables import FIRST_ROWS

    experiment = read_experiment(config.experiment)
    folder = Path(config.out) if config.out else Path.cwd() / "results" / Path(config.experiment).stem
    for name in config.parts:
        if name not in experiment.parts:
            raise unknown_choice("parts", name, experiment.parts)
    runs, left_out = [], []
    for name in experiment.parts:
        if config.parts and name not in config.parts:
            continue
        if config.play and config.dataset is None and reads_folder(experiment.parts[name].task):
            left_out.append(f"Part {name} needs dataset=FOLDER, and is left out.")
        else:
            runs.append(PartRun(experiment, name, folder, config))
    texts, said = [], []
    for each in runs:
        if config.play:
            each.play()
        else:
            each.store.read(mend=False)
        lacking = each.missing()
        absent = summing_up.missing_words(lacking)
        texts += [f"## {each.name}", absent]
        learning = update_learning(each.folder)
        for summary in summing_up.sum_up(each, lacking, learning):
            shown = summing_up.as_tables(each, summary, learning)
            said.append(f"{each.name}: {summing_up.verdict(each, summary)}")
            texts += [said[-1], *(f"{table.title}:\n\n{table.markdown()}" for table in shown)]
            for table in shown if config.verbose else [shown[0].first(FIRST_ROWS)]:
                table.show()
        said += [f"{each.name}: {absent}"] if absent else []
    written = []
    if folder.is_dir():
        write_text(folder / TABLES_FILE, "\n\n".join(filter(None, [*texts, *left_out])) + "\n")
        written.append(f"Results: {folder}, {TABLES_FILE}")
    for line in [*left_out, *written, *said]:
        print(line, flush=True)
    return folder


COMMAND = OptionCommand(
    name="benchmarks.campaign",
    summary="Train, play and compare what an experiment lists, and make its tables, figures and leaderboard files.",
    examples=(
        "izoo.benchmarks.campaign",
        "izoo.benchmarks.campaign experiment=reference dataset=DATASET out=FOLDER",
        "izoo.benchmarks.campaign experiment=reference parts=[busy_lane] out=FOLDER",
        "izoo.benchmarks.campaign experiment=mine.yaml out=FOLDER play=false",
    ),
    config="izoo.benchmarks.campaign.__main__:CampaignConfig",
    work="izoo.benchmarks.campaign.__main__:run",
    stopped=GOES_ON,
)
main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
