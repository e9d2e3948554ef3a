"""The commands whose options are written ``option=value``; each is run by the file that it is named after."""

from __future__ import annotations

from izoo.cli.option_command import GOES_ON, OptionCommand

TRAIN = OptionCommand(
    name="train",
    summary="Train a policy on eco-driving contexts, then compare it with human driving.",
    examples=(
        "izoo.train",
        "izoo.train recipe=busy_lane seed=1",
        "izoo.train contexts=pcg_easy total_frames=100000 seed=1",
        "izoo.train contexts=dataset contexts.path=DIR algo=ppo algo.lr=1e-4 num_workers=8",
        "izoo.train -m seed=0,1,2,3",
        "izoo.train resume=runs/RUN total_frames=500000",
    ),
    config="izoo.conf.train_options:TrainConfig",
    work="izoo.cli.train:train",
    check="izoo.cli.path_checks:check_train",
    recipes=True,
)
EVALUATE = OptionCommand(
    name="evaluate",
    summary="Compare a policy with human driving on the same episodes, and say what it saves.",
    examples=(
        "izoo.evaluate run=runs/RUN",
        "izoo.evaluate run=runs/RUN contexts=dataset contexts.path=DATASET seeds=5 num_workers=8",
        "izoo.evaluate policy=glide contexts=pcg num_contexts=32 simulator=twin",
        "izoo.evaluate policy=mine.pt contexts=city contexts.city=atlanta",
        "izoo.evaluate policy=my_package.drivers:calm out=results/calm",
    ),
    config="izoo.conf.evaluate_options:EvaluateConfig",
    work="izoo.cli.evaluate:evaluate",
    check="izoo.cli.path_checks:check_evaluate",
    before="izoo.cli.path_checks:contexts_of_run",
    stopped=GOES_ON,
)
COLLECT = OptionCommand(
    name="collect",
    summary="Store what a policy experiences as a memory-mapped TensorDict, for offline learning.",
    examples=(
        "izoo.collect policy=random frames=20000 out=DIR",
        "izoo.collect policy=runs/RUN frames=100000 out=DIR contexts=dataset contexts.path=DATASET",
    ),
    config="izoo.conf.train_options:CollectConfig",
    work="izoo.training.offline:collect",
    check="izoo.cli.path_checks:check_collect",
)
REPORT = OptionCommand(
    name="report",
    summary="Write results as one HTML page that opens from disk; of a sweep, show its runs side by side.",
    examples=(
        "izoo.report results/productivity-small out=report.html",
        "izoo.report runs/DATE-sweep",
    ),
    config="izoo.conf.report_options:ReportConfig",
    work="izoo.cli.report:report",
    check="izoo.cli.path_checks:check_report",
    place="results",
    literal=("results", "out", "title"),
)
