"""Options: YAML equals the dataclasses, and whatever a user gets wrong is one sentence and exit code 2."""

from __future__ import annotations

import dataclasses
import io
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from izoo import collect, console, evaluate, train
from izoo.algos.learners.ppo import PPOConfig
from izoo.benchmarks import generalization
from izoo.cli import compose
from izoo.cli.option_command import OptionCommand
from izoo.conf.context_choices import DatasetContexts, PcgContexts
from izoo.conf.mapping import from_mapping, to_mapping
from izoo.conf.train_options import CollectConfig, TrainConfig
from izoo.contexts.distributions import Uniform
from izoo.contexts.procedural import SYSTEMATICITY_TRAIN
from izoo.envs import RewardConfig
from izoo.errors import IzooError
from izoo.files import claimed
from izoo.results.store import read_manifest


@pytest.mark.parametrize(("name", "cls"), [("train", TrainConfig), ("collect", CollectConfig)])
def test_yaml_equals_the_dataclass(name: str, cls: type) -> None:
    assert compose.compose_config(name, cls, []) == cls()


OPTION_GROUPS = {field.name for field in dataclasses.fields(TrainConfig)}
CHOICES = [f"{group}={name}" for group, names in compose.choices().items() if group in OPTION_GROUPS for name in names]


@pytest.mark.parametrize("word", CHOICES)
def test_every_choice_equals_its_dataclass(word: str) -> None:
    """But for the fields that make the choice what it is."""
    group, choice = word.split("=")
    value = getattr(compose.compose_config(TrainConfig, [word]), group)
    if choice.endswith("_paper"):
        assert value == type(value).paper()
        return
    default = type(value)()
    fields = [field.name for field in dataclasses.fields(value)]
    changed = {name for name in fields if getattr(value, name) != getattr(default, name)}
    # The training command switches off what learners do not read.
    assert changed <= {"name", "preset", "emit"}


def test_the_choices_of_the_manual_exist() -> None:
    assert {"algo=ppo", "algo=ppo_paper", "contexts=pcg", "contexts=dataset", "logger=wandb"} <= set(CHOICES)
    assert {"collector=single", "collector=parallel", "collector=multisync"} <= set(CHOICES)


def test_configs_survive_yaml() -> None:
    config = TrainConfig(contexts=DatasetContexts(path="data"), seed=4, algo=PPOConfig(hidden=(16, 8)))
    assert from_mapping(TrainConfig, to_mapping(config)) == config


def test_options_reach_the_dataclass_with_their_types(tmp_path: Path) -> None:
    odd = tmp_path / "a (1), b=c"
    words = ["algo.lr=1e-4", "algo.hidden=[8,8]", "total_frames=1e6", "env.reward.eta=0", f"run_dir={odd}"]
    config = compose.compose_config(TrainConfig, words)
    assert config.algo.lr == 1e-4
    assert config.algo.hidden == (8, 8)
    assert config.total_frames == 1_000_000
    assert isinstance(config.total_frames, int)
    assert config.env.reward.eta == 0.0
    assert config.run_dir == str(odd)


def test_configs_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        TrainConfig().seed = 1  # type: ignore[misc]


def test_procedural_settings() -> None:
    contexts = PcgContexts(lane_count=2.0, green_s="20..32", phase_count=[1, 2], adoption=0.5)
    features = contexts.build().product.features  # type: ignore[attr-defined]
    assert features["lane_count"].value == 2
    assert features["green_s"] == Uniform(20.0, 32.0)
    assert features["phase_count"].values == (1, 2)
    assert features["speed_limit_mps"] == SYSTEMATICITY_TRAIN.product.features["speed_limit_mps"]


BAD = {
    "seed=zero": "whole number",
    "sead=1": "Did you mean 'seed'?",
    "lr=1": "Did you mean 'algo.lr'?",
    "algo=pppo": "Did you mean 'ppo'?",
    "contexts=pgc": "choose one of: ",
    "contexts.path=x": "It is an option of contexts=dataset",
    "algo.gamma=2": "algo.gamma is 2.0",
    "algo.hidden=[]": "algo.hidden",
    "algo.hidden=8": "must be a list",
    "algo.name=ddpg": "algo.name",
    "env.horizon_s=10": "horizon",
    "env.emit=[vehicle]": "Did you mean 'vehicles'?",
    "env=3": "unknown env",
    "seed=0,1": "add -m",
    "ppo": "option=value",
    "--hlep": "Did you mean '--help'?",
    "+new=1": "unknown option 'new'",
    "num_workers=0": "num_workers is 0",
    "seed=2147483648": "must lie in [0, 2147483647]",
    "resume=nowhere": "does not exist",
    "contexts=dataset": "contexts.path=DIR",
    "contexts=pcg contexts.green_s=20..x": "low..high",
    "contexts=pcg contexts.green_s=900": "green_s",
    "contexts=pcg contexts.lane_count=9": "lane_count",
}


@pytest.mark.parametrize("word", BAD)
def test_bad_words_are_one_sentence(
    word: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert train.main(word.split(" ")) == 2
    error = capsys.readouterr().err
    assert BAD[word] in error
    assert "Traceback" not in error
    assert len(error.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == [], "bad input must leave nothing behind"


def test_bad_dataset_folders(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    empty = tmp_path / "empty"
    empty.mkdir()
    for path in (tmp_path / "missing", empty):
        assert train.main(["contexts=dataset", f"contexts.path={path}"]) == 2
        assert str(path) in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_a_sweep_is_checked_before_its_first_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert train.main(["-m", "seed=0,1", "algo.gamma=0.9,1.9"]) == 2
    assert "algo.gamma is 1.9" in capsys.readouterr().err
    assert train.main(["-m", "algo=ppo,sac"]) == 2
    assert list(tmp_path.iterdir()) == []


def test_help_names_every_option_with_its_meaning(capsys: pytest.CaptureFixture[str]) -> None:
    for command in (train, collect):
        assert command.main(["--help"]) == 0
        page = capsys.readouterr().out
        assert "Usage: python -m izoo." in page
        lines = page[page.index("Options") :].splitlines()
        options = [k for k, line in enumerate(lines) if line.startswith("  ") and not line.startswith("      ")]
        undocumented = [lines[k].strip() for k in options if not lines[k + 1 : k + 2] or lines[k + 1].strip() == ""]
        bare = [lines[k].strip() for k in options if not (k + 1 < len(lines) and lines[k + 1].startswith("      "))]
        assert undocumented == [] and bare == []
        assert max(map(len, page.splitlines())) <= 140
        assert re.findall(r":class:|\bNone\b", page) == [], "words of Python that cannot be typed"
        assert "threads that share the environments out among them" in page
        assert "a whole multiple of step_s; null: one step" in page


@pytest.mark.parametrize("reader", ["head -n 1", "true"])
def test_output_that_nobody_reads_ends_a_command_quietly(reader: str) -> None:
    command = f"{sys.executable} -m izoo.evaluate --help | {reader}; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize(("errors", "collector"), [("", "single"), ("2>&1", "parallel")])
def test_work_goes_on_where_nobody_reads_its_output(tmp_path: Path, errors: str, collector: str) -> None:
    words = f"contexts=pcg_easy total_frames=400 num_workers=1 evaluation.contexts=0 run_dir={tmp_path / 'run'}"
    words += f" env.horizon_s=60 algo.frames_per_batch=200 algo.hidden=[16] collector={collector}"
    command = f"{sys.executable} -m izoo.train {words} {errors} | head -n 1; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=250)
    assert done.returncode == 0 and ("the work goes on" in done.stderr) == (errors == "")
    assert max(int(line.split(",")[0]) for line in (tmp_path / "run/metrics.csv").read_text().splitlines()[1:]) >= 400


def test_runs_of_a_sweep_do_not_share_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert train.main(["-m", "seed=0,1", f"run_dir={tmp_path}"]) == 2
    assert f"2 runs would share the folder {tmp_path}; make run_dir differ" in capsys.readouterr().err


def test_commands_that_compose_options_can_be_swept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["protocol=systematicity", "algos=[uncommanded]", "test_limit=1", "horizon_s=60", "num_workers=0"]
    outs = ["eval_seeds=3,4", f"out={tmp_path}/${{eval_seeds}}"]
    assert generalization.main(["-m", *words, *outs, f"cache={tmp_path / 'cache'}"]) == 0
    assert all(read_manifest(tmp_path / name).complete for name in "34")


@pytest.mark.parametrize("stream", [sys.__stdout__, io.StringIO(), None], ids=["open", "no file", "none"])
def test_a_broken_pipe_elsewhere_is_not_hidden(stream: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", stream)

    def broken() -> int:
        raise BrokenPipeError("a worker's socket")

    with pytest.raises(BrokenPipeError, match="socket"):
        console.exit_code("train", broken)


def test_cfg_prints_the_resolved_options(capsys: pytest.CaptureFixture[str]) -> None:
    assert train.main(["--cfg", "seed=5"]) == 0
    assert "seed: 5" in capsys.readouterr().out


def test_cfg_of_a_sweep_prints_every_combination_and_runs_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert train.main(["-m", "--cfg", "seed=0,1", "algo=ppo,ddpg", "evaluation.seeds=0,3"]) == 2
    capsys.readouterr()

    def work(*_: object) -> None:
        raise AssertionError("--cfg stops before the work")

    monkeypatch.setattr(OptionCommand, "_work", work)
    assert train.main(["-m", "--cfg", "seed=0,1", "algo=ppo,ddpg"]) == 0
    first_line, _, rest = capsys.readouterr().out.partition("\n")
    assert first_line.startswith("izoo ")
    shown = [(config["seed"], config["algo"]["name"]) for config in yaml.safe_load_all(rest)]
    assert shown == [(0, "ppo"), (0, "ddpg"), (1, "ppo"), (1, "ddpg")]
    assert list(tmp_path.iterdir()) == []


def test_cfg_of_a_large_sweep_says_that_not_all_is_shown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(compose, "MAX_CHECKED", 2)
    assert collect.main(["-m", "--cfg", "seed=0,1,2"]) == 0
    out = capsys.readouterr().out
    assert "seed: 1" in out and "seed: 2" not in out and "no more than 2 combinations are shown" in out


def test_entries_of_a_list_that_need_quotes_are_shown_with_them(capsys: pytest.CaptureFixture[str]) -> None:
    remedy = 'train_options=["algo.frames_per_batch=200","algo.hidden=[8,8]"]'
    unquoted = remedy.replace('"', "")
    assert generalization.main(["--cfg", unquoted]) == 2
    error = capsys.readouterr().err
    assert "put double quotes around entries that hold =" in error and f"'{remedy}'" in error
    assert generalization.main(["--cfg", remedy]) == 0
    assert "- algo.hidden=[8,8]" in capsys.readouterr().out


def test_the_first_line_comes_at_once(tmp_path: Path) -> None:
    start = time.monotonic()
    command = [sys.executable, "-m", "izoo.train", "--help"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("izoo ")
        elapsed = time.monotonic() - start
        process.stdout.read()
    assert process.returncode == 0
    assert elapsed < 1.0


COMMANDS = ("train", "evaluate", "collect", "benchmarks.generalization", "benchmarks.tradeoffs")


@pytest.mark.parametrize("name", COMMANDS)
def test_commands_answer_before_pytorch_is_loaded(name: str) -> None:
    program = (
        f"import sys; from izoo.{name} import main; codes = main(['--help']), main(['nonsense=1']); "
        "sys.exit(codes != (0, 2) or 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "unknown option 'nonsense'" in done.stderr


MISSING = {
    "train resume=nowhere": "nowhere does not exist",
    "train contexts=dataset contexts.path=nowhere": "nowhere does not exist",
    "train contexts=dataset": "contexts.path=DIR",
    "train contexts=osm contexts.path=nowhere": "nowhere does not exist",
    "train contexts=osm contexts.path=.": "holds no intersections built from OpenStreetMap",
    "train -m seed=0,1 contexts=dataset contexts.path=nowhere": "nowhere does not exist",
    "evaluate run=nowhere": "nowhere does not exist",
    "evaluate run=.": "holds no checkpoint",
    "evaluate policy=no_such_package.drivers:calm": "there is no module 'no_such_package'",
    "evaluate policy=glide contexts=dataset contexts.path=nowhere": "nowhere does not exist",
    "evaluate policy=zoo:nobody": "unknown policy 'zoo:nobody'",
    "collect policy=zoo:nobody out=data": "unknown policy 'zoo:nobody'",
    "collect policy=nowhere out=data": "there is none at that path",
    "collect policy=random": "out is missing",
    "collect policy=random out=data contexts=dataset contexts.path=nowhere": "nowhere does not exist",
    "report nowhere": "nowhere is no folder",
    "leaderboard validate nowhere.json": "nowhere.json does not exist",
    "contexts import nowhere data": "nowhere does not exist",
    "benchmarks.generalization train=nowhere": "unknown city 'nowhere'",
    "benchmarks.tradeoffs train=./nowhere": "nowhere is no folder",
}


@pytest.mark.parametrize("words", MISSING)
def test_missing_paths_are_refused_before_pytorch_is_loaded(words: str, tmp_path: Path) -> None:
    name, *rest = words.split(" ")
    module = f"{name}.__main__" if name in ("contexts", "report") else name
    program = (
        f"import sys; from izoo.{module} import main; sys.exit((main({rest}) != 2) + 2 * ('torch' in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert MISSING[words] in done.stderr and "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == [], "bad input must leave nothing behind"


FILLING = {
    "collect": "policy=random frames=50 out={}",
    "evaluate": "policy=glide contexts=pcg_easy num_contexts=1 seeds=1 num_workers=0 out={}",
    "benchmarks.generalization": "protocol=systematicity algos=[glide] test_limit=1 num_workers=0 out={}",
    "benchmarks.planner": "contexts=pcg_easy num_contexts=1 out={}",
    "benchmarks.twin": "contexts=pcg_easy num_contexts=1 out={}",
}
"""Commands that fill a folder, and the least that they need."""


@pytest.mark.slow
@pytest.mark.parametrize("name", FILLING)
def test_no_command_fills_a_folder_that_another_process_fills(name: str, tmp_path: Path) -> None:
    words = FILLING[name].format(tmp_path / "out").split(" ")
    command = [sys.executable, "-m", f"izoo.{name}", *words]
    with claimed(tmp_path / "out"):
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=200)
        assert done.returncode == 2 and "another process works in" in done.stderr, done.stderr
        assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize("words", ["train", "evaluate policy=glide", "collect out=data", "report nowhere"])
def test_a_current_folder_that_was_removed_is_one_sentence(words: str, tmp_path: Path) -> None:
    name, *rest = words.split(" ")
    program = f"import os, sys; os.rmdir(os.getcwd()); from izoo.{name} import main; sys.exit(main({rest}))"
    program = program.replace("izoo.report import", "izoo.report.__main__ import")
    (tmp_path / "here").mkdir()
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path / "here", capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == f"izoo {name}: the current folder has been removed; change to one that exists.\n"


def test_results_do_not_go_into_a_folder_of_other_things(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("All of it.")
    assert evaluate.main(["policy=glide", f"out={tmp_path}"]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_unknown_nested_option_lists_its_siblings() -> None:
    with pytest.raises(IzooError, match=r"env\.reward\.etta.*env\.reward\.eta"):
        compose.compose_config(TrainConfig, ["env.reward.etta=1"])


def test_a_reward_is_chosen_by_name_and_changed_by_weight() -> None:
    chosen = compose.compose_config(TrainConfig, ["env.reward.delay=-0.3", "env.reward=fuel_team"]).env.reward
    assert chosen == dataclasses.replace(RewardConfig.fuel_team(), delay=-0.3)
    assert compose.compose_config(TrainConfig, ["env.reward=paper"]).env.reward == RewardConfig()
    with pytest.raises(IzooError, match=r"env\.reward.*paper, fuel, fuel_team"):
        compose.compose_config(TrainConfig, ["env.reward=fuell"])
