"""The command line: options, choices, help and sweeps; whatever a user gets wrong is one sentence and exit code 2."""

import dataclasses
import importlib
import io
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from izoo import __main__ as izoo
from izoo import collect, console, evaluate, train
from izoo.algos.learners.ddpg import DDPGConfig
from izoo.benchmarks.twin import FidelityConfig
from izoo.cli.option_command import compose_config
from izoo.conf.choices import groups
from izoo.conf.context_choices import DatasetContexts, PcgContexts
from izoo.conf.train_options import CollectConfig, TrainConfig
from izoo.envs import RewardConfig
from izoo.options import from_mapping, to_mapping
from izoo.results.store import read_manifest
from tests.conftest import Refused


@pytest.mark.parametrize("cls", [TrainConfig, CollectConfig, FidelityConfig])
def test_without_words_options_have_their_defaults(cls: type) -> None:
    assert compose_config(cls, []) == cls()


@pytest.mark.parametrize("group", [name for name in groups() if name != "env.reward"])
def test_every_choice_is_composed_and_survives_yaml(group: str) -> None:
    for name, make in groups()[group].items():
        config = compose_config(TrainConfig, [f"{group}={name}"])
        assert getattr(config, group) == make()
        assert from_mapping(TrainConfig, yaml.safe_load(yaml.safe_dump(to_mapping(config)))) == config


def test_options_reach_the_dataclass_with_their_types(tmp_path: Path) -> None:
    odd = tmp_path / "a (1), b=c"
    words = ["algo.lr=1e-4", "algo.hidden=[8,8]", "total_frames=1e6", "env.reward.eta=0", f"run_dir={odd}"]
    config = compose_config(TrainConfig, words)
    assert (config.algo.lr, config.algo.hidden) == (1e-4, (8, 8))  # type: ignore[attr-defined]
    assert config.total_frames == 1_000_000 and isinstance(config.total_frames, int)
    assert config.env.reward.eta == 0.0 and config.run_dir == str(odd)
    assert from_mapping(TrainConfig, to_mapping(dataclasses.replace(config, contexts=DatasetContexts(path="data"))))


def test_a_reward_is_chosen_by_name_and_changed_by_weight() -> None:
    chosen = compose_config(TrainConfig, ["env.reward.delay=-0.3", "env.reward=fuel_team"]).env.reward
    assert chosen == dataclasses.replace(RewardConfig.fuel_team(), delay=-0.3)
    assert compose_config(TrainConfig, ["env.reward=paper"]).env.reward == RewardConfig()


def test_a_task_sets_what_other_words_do_not() -> None:
    config = compose_config(TrainConfig, ["algo=ppo_vehicle", "seed=3", "env.num_agents=8", "task=busy_lane"])
    assert (config.task, config.simulator, config.total_frames, config.seed) == ("busy_lane", "twin", 92_160, 3)
    assert (config.env.decide, config.env.num_agents, config.env.emit) == ("vehicle", 8, ("number",))
    assert config.contexts == dataclasses.replace(PcgContexts(), **{
        **{"lane_count": 1.0, "phase_count": 1.0, "inflow_vph_per_lane": "400..600", "green_s": "20..26"},
        **{"red_s": "24..32", "lane_length_m": "250..500"},
    })  # fmt: skip
    other = compose_config(TrainConfig, ["task=busy_lane", "contexts=city", "action=direct", "env.reward=paper"])
    assert other.contexts.name == "city" and other.env.reward == RewardConfig()
    assert (other.env.decide, other.env.action) == ("step", "acceleration")
    arriving = compose_config(TrainConfig, ["task=busy_lane", "action=arrive"])
    assert (arriving.env.decide, arriving.env.action_size) == ("vehicle", 2)
    tested = evaluate.COMMAND.compose(["task=salt_lake_city_to_atlanta", "policy=glide", "contexts.adoption=1"])
    assert (tested.contexts.city, tested.contexts.split, tested.contexts.adoption) == ("atlanta", "test", 1.0)
    assert (tested.num_contexts, tested.seeds, tested.env.drain_s, tested.env.decide) == (96, 1, 600.0, "step")


BAD = {
    "train seed=zero": "whole number",
    "train sead=1": "Did you mean 'seed'?",
    "train lr=1": "Did you mean 'algo.lr'?",
    "train algo.learning_rate=1": "Did you mean 'algo.lr'?",
    "train algo=pppo": "Did you mean 'ppo'?",
    "train algo=nowhere:Mine": "No module named 'nowhere'",
    "train task=busy_road": "Did you mean 'busy_lane'?",
    "train contexts=pgc": "choose one of: ",
    "train contexts=json:JSONDecoder": "sample(generator)",
    "train contexts.path=x": "It is an option of contexts=dataset",
    "train algo.gamma=2": "algo.gamma is 2.0",
    "train algo.hidden=[]": "algo.hidden",
    "train algo.hidden=8": "must be a list",
    "train algo.name=ddpg": "unknown option",
    "train env.horizon_s=10": "horizon",
    "train env.emit=[vehicle]": "Did you mean 'vehicles'?",
    "train env.reward=fuell": "paper, fuel, fuel_team",
    "train env.reward.etta=1": "Did you mean 'env.reward.eta'?",
    "train env=3": "a group of options",
    "train simulator=sumoo": "Did you mean 'sumo'?",
    "train seed=0,1": "add -m",
    "train ppo": "option=value",
    "train --hlep": "Did you mean '--help'?",
    "train +new=1": "unknown option 'new'",
    "train num_workers=0": "num_workers is 0",
    "train seed=2147483648": "must lie in [0, 2147483647]",
    "train resume=nowhere": "does not exist",
    "train contexts=dataset contexts.path=nowhere": "nowhere does not exist",
    "train contexts=osm contexts.path=.": "holds no intersections built from OpenStreetMap",
    "train -m seed=0,1 algo.gamma=0.9,1.9": "algo.gamma is 1.9",
    "train -v": "unknown option 'verbose'",
    "train run_dir=": "run_dir is empty; give a path",
    "train start=": "start is empty",
    "train run_dir=a${b": "the options do not fit together",
    "train -m contexts=city contexts.city=atlanta,atlnta": "atlnta",
    "evaluate run=nowhere": "nowhere does not exist",
    "evaluate run=.": "holds no checkpoint",
    "evaluate policy=no_such_package.drivers:calm": "no_such_package",
    "evaluate policy=glide contexts=dataset contexts.path=nowhere": "nowhere does not exist",
    "evaluate policy=zoo:nobody": "unknown policy 'zoo:nobody'",
    "evaluate policy=glide checkpoint=best": "run is not given",
    "evaluate": "give one of run=RUN_DIR and policy=NAME",
    "collect policy=zoo:nobody out=data": "unknown policy 'zoo:nobody'",
    "collect policy=nowhere out=data": "nowhere",
    "collect policy=random": "out is missing",
    "report nowhere": "nowhere",
    "leaderboard validate nowhere.json": "nowhere.json does not exist",
    "contexts import nowhere data": "nowhere does not exist",
    "trian": "Did you mean 'train'?",
}


@pytest.mark.parametrize("words", BAD)
def test_bad_words_are_one_sentence_and_leave_nothing_behind(words: str, here: Path, refused: Refused) -> None:
    refused(izoo.main, words.split(" "), BAD[words])
    assert list(here.iterdir()) == []


def test_every_command_is_listed_and_has_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert izoo.main([]) == 0
    listed = capsys.readouterr().out
    for name, (module, meaning) in izoo.COMMANDS.items():
        assert f"  {name} " in listed and meaning in listed
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", [name])
            try:
                assert importlib.import_module(module).main(["--help"]) == 0
            except SystemExit as done:  # of argparse
                assert done.code == 0
        assert f"python -m izoo.{name}" in capsys.readouterr().out


def test_help_names_every_option_with_its_meaning(capsys: pytest.CaptureFixture[str]) -> None:
    for command in (train, collect):
        assert command.main(["--help"]) == 0
        page = capsys.readouterr().out
        lines = page[page.index("Options") :].splitlines()
        options = [k for k, line in enumerate(lines) if line.startswith("  ") and not line.startswith("      ")]
        bare = [lines[k].strip() for k in options if not (k + 1 < len(lines) and lines[k + 1].startswith("      "))]
        assert len(options) > 30 and bare == []
        assert re.findall(r":class:|\bNone\b", page) == [], "words of Python that cannot be typed"


def test_help_is_that_of_the_choices_that_are_made(capsys: pytest.CaptureFixture[str]) -> None:
    assert train.main(["--help", "algo=ddpg", "task=busy_lane"]) == 0
    page = capsys.readouterr().out
    assert f"algo.actor_lr={DDPGConfig().actor_lr}" in page and "algo.clip_epsilon" not in page
    assert "algo=ddpg:" in page and "env.decide=vehicle" in page
    assert "env.reward=paper | fuel | fuel_team" in page and "task=busy_lane: one-lane approaches" in page


def test_the_first_line_comes_at_once(tmp_path: Path) -> None:
    start = time.monotonic()
    command = [sys.executable, "-m", "izoo.train", "--help"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("izoo ")
        assert time.monotonic() - start < 1.0
        process.terminate()


def test_cfg_prints_the_options_of_every_run_and_runs_none(
    here: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    assert train.main(["--cfg", "seed=5"]) == 0
    assert "seed: 5" in capsys.readouterr().out
    assert train.main(["-m", "--cfg", "seed=0,1", "algo=ppo,ddpg"]) == 0
    first_line, _, rest = capsys.readouterr().out.partition("\n")
    assert first_line.startswith("izoo ")
    shown = [(config["seed"], config["algo"]["name"]) for config in yaml.safe_load_all(rest)]
    assert shown == [(0, "ppo"), (0, "ddpg"), (1, "ppo"), (1, "ddpg")]
    refused(train.main, ["--cfg", "contexts=city", "contexts.city=atlantis"], "Did you mean 'atlanta'?")
    assert list(here.iterdir()) == []


def test_every_run_of_a_sweep_has_a_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    folders: list[str] = []

    def work(config: TrainConfig) -> None:
        folders.append(str(config.run_dir))

    monkeypatch.setattr("izoo.train.run", work)
    assert train.main(["-m", "seed=0,1", "algo=ppo,cmaes_teams"]) == 0
    assert [re.sub(".*-sweep/", "", folder) for folder in folders] == [
        *("0-ppo-seed0", "1-cmaes-seed0", "2-ppo-seed1", "3-cmaes-seed1"),
    ]
    assert train.main(["-m", "seed=0,1", "run_dir=runs/${algo.name}-${seed}"]) == 0
    assert [Path(folder).name for folder in folders[4:]] == ["ppo-0", "ppo-1"]
    assert train.main(["-m", "seed=0,1", "run_dir=runs/lane"]) == 0
    assert [Path(folder).relative_to(Path.cwd()) for folder in folders[6:]] == [
        *(Path("runs/lane/0-ppo-seed0"), Path("runs/lane/1-ppo-seed1")),
    ]


def test_a_sweep_over_evaluations(here: Path) -> None:
    words = ["policy=uncommanded", "contexts=pcg_easy", "env.horizon_s=60", "num_workers=0", "seeds=1,2"]
    assert evaluate.main(["-m", *words, f"out={here}/${{seeds}}", f"cache={here / 'cache'}"]) == 0
    assert all(read_manifest(here / name).complete for name in "12")


@pytest.mark.parametrize("stream", [sys.__stdout__, io.StringIO(), None], ids=["open", "no file", "none"])
def test_a_broken_pipe_elsewhere_is_not_hidden(stream: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", stream)

    def broken() -> int:
        raise BrokenPipeError("a worker's socket")

    with pytest.raises(BrokenPipeError, match="socket"):
        console.exit_code("train", broken)


def test_a_current_folder_that_was_removed_is_one_sentence(tmp_path: Path) -> None:
    program = "import os, sys; os.rmdir(os.getcwd()); from izoo.train import main; sys.exit(main([]))"
    (tmp_path / "here").mkdir()
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path / "here", capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == "izoo train: the current folder has been removed; change to one that exists.\n"
