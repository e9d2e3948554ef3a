"""Algorithms, contexts, tasks and policies of one's own, without a line in izoo: ``algo=module:Class`` and others.

The algorithm and the contexts are those that the page on extending izoo shows.
"""

import csv
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from izoo import evaluate, train
from izoo.algos.learners import registry
from izoo.algos.learners.ppo import PPOConfig
from izoo.cli.option_command import compose_config
from izoo.conf.train_options import TrainConfig
from izoo.errors import IzooError
from izoo.imports import imported
from izoo.training import checkpoint, run_folder
from izoo.training.validation import VALIDATION_FILE
from tests.conftest import Refused
from tests.docs.blocks import DOCS, blocks_of

ALGO = "algo=weighted:RewardWeighted"
TOY = [
    *("task=my_tasks:SHORT", "env.horizon_s=60", "num_workers=1", "collector=single", "algo.frames_per_batch=70"),
    *("evaluation.contexts=0", "validation.every_batches=1", "validation.contexts=1", "validation.seeds=1"),
]
TASKS = """
import dataclasses
from izoo import tasks
from izoo.conf.context_choices import OwnContexts
from izoo.envs import EnvConfig

HILLS = OwnContexts("hills:Downhill")
SHORT = tasks.Task("short", "downhill streets", "nothing", HILLS, HILLS, HILLS, EnvConfig(), test_contexts=2)
"""


@pytest.fixture
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The current folder, with the modules of the page."""
    codes = [block.code for block in blocks_of(DOCS / "extending.md")]
    (tmp_path / "weighted.py").write_text(next(code for code in codes if "class RewardWeighted" in code))
    hills = next(code for code in codes if "class Downhill" in code)
    (tmp_path / "hills.py").write_text(hills[: hills.index("env = ")])
    (tmp_path / "my_tasks.py").write_text(TASKS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield tmp_path
    for name in ("weighted", "hills", "my_tasks"):
        sys.modules.pop(name, None)


@pytest.mark.slow
def test_an_own_algorithm_trains_validates_resumes_and_is_evaluated(
    own_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train.main([*TOY, ALGO, "algo.lr=3e-3", "total_frames=140", "seed=5", "run_dir=run"]) == 0
    config = run_folder.read_config(own_folder / "run")
    assert (config.algo.name, config.contexts.name) == ("weighted:RewardWeighted", "hills:Downhill")
    assert vars(config.algo)["lr"] == 3e-3
    with (own_folder / "run" / VALIDATION_FILE).open() as file:
        assert [int(float(row["frames"])) for row in csv.DictReader(file)][-1] == 140, "played in another process"
    assert checkpoint.best_of(own_folder / "run") is not None
    assert train.main(["resume=run", "total_frames=210"]) == 0
    assert checkpoint.frames_of(checkpoint.find(own_folder / "run")) == 210
    assert "Traceback" not in capsys.readouterr().err

    words = ["run=run", "num_workers=1", "env.horizon_s=60", "name=mine", "out=results"]
    assert evaluate.main(words) == 0
    entry = json.loads((own_folder / "results" / "leaderboard" / "mine.json").read_text())
    policy = entry["policy"]
    assert (entry["task"], policy["algo"], policy["frames"]) == ("short", "weighted:RewardWeighted", 210)
    assert len(policy["weights"]) == 1 and 5 in entry["rows"]["train_seed"]


@pytest.mark.usefixtures("own_folder")
def test_own_choices_have_help_and_options(capsys: pytest.CaptureFixture[str], refused: Refused) -> None:
    assert train.main(["--help", ALGO]) == 0
    assert "algo.noise_mps2=0.5" in capsys.readouterr().out
    said = "choose one of: algo.name, algo.frames_per_batch, algo.lr, algo.noise_mps2"
    refused(train.main, ["algo.noise=1", ALGO], said)
    config = compose_config(TrainConfig, [ALGO, "contexts=hills:Downhill"])
    assert registry.make_algorithm(config.algo, config.action, config.env).policy is not None
    assert evaluate.COMMAND.compose(["task=my_tasks:SHORT", "policy=glide"]).num_contexts == 2


@pytest.fixture
def mine(here: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A module of the user's in the current folder, still to be written."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield here / "mine.py"
    sys.modules.pop("mine", None)


@pytest.mark.parametrize(
    ("place", "message"),
    [
        (":Mine", "policy=:Mine is not of the form module:name, such as mine:drive."),
        ("mine:", "policy=mine: is not of the form module:name, such as mine:drive."),
        ("./mine.py:drive", "policy=./mine.py:drive is not of the form module:name, such as mine:drive."),
        (".mine:drive", "policy=.mine:drive is not of the form module:name, such as mine:drive."),
        ("nowhere.mine:drive", "policy=nowhere.mine:drive: No module named 'nowhere'."),
        ("mine.deeper:drive", "policy=mine.deeper:drive: No module named 'mine.deeper'; 'mine' is not a package."),
        ("mine:other", "policy=mine:other: the module mine has no other."),
    ],
)
def test_a_place_where_nothing_is_is_one_sentence(mine: Path, place: str, message: str) -> None:
    mine.write_text("drive = 1\n")
    assert imported("policy", "mine:drive") == 1
    with pytest.raises(IzooError) as caught:
        imported("policy", place)
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("code", "kind"), [("import nowhere_at_all", ModuleNotFoundError), ("1 / 0", ZeroDivisionError)]
)
def test_errors_in_the_users_module_are_theirs(mine: Path, code: str, kind: type[Exception]) -> None:
    mine.write_text(f"{code}\n")
    with pytest.raises(kind):
        imported("policy", "mine:drive")


def test_a_variant_of_an_algorithm_composes_with_its_options(mine: Path) -> None:
    mine.write_text("from izoo.algos.learners.ppo import PPO\n\n\nclass Mine(PPO):\n    pass\n")
    config = compose_config(TrainConfig, ["algo=mine:Mine", "algo.hidden=[8]"])
    assert isinstance(config.algo, PPOConfig) and (config.algo.name, config.algo.hidden) == ("mine:Mine", (8,))
    assert type(registry.make_algorithm(config.algo, config.action, config.env)).__name__ == "Mine"
