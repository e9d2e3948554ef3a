"""Trained policies that ship: read and written, refused where damaged, exported from a run, and played."""

import contextlib
import dataclasses
import re
import shlex
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo import collect, evaluate, train, zoo
from izoo.algos.actions.action_modes import AdviseAction
from izoo.algos.learners.ppo import PPOConfig
from izoo.algos.learners.registry import make_algorithm
from izoo.benchmarks import twin
from izoo.benchmarks.campaign.__main__ import CampaignConfig
from izoo.benchmarks.campaign.experiment import read_experiment
from izoo.benchmarks.campaign.jobs import PartRun
from izoo.cli.option_command import compose_config
from izoo.cli.zoo import ZOO, _changed
from izoo.conf.train_options import TrainConfig
from izoo.contexts.procedural import procedural_context
from izoo.envs import EcoDrivingEnv
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.errors import IzooError
from izoo.report import __main__ as report
from izoo.results import read_table
from izoo.results.policies import as_policy, weights_hash
from izoo.results.store import read_manifest
from izoo.training import run_folder
from izoo.zoo import catalog
from tests.conftest import Refused
from tests.report.made_tables import folder, table

ENV = EnvConfig(horizon_s=75.0, hold_s=3.0, emit=())
CONFIG = TrainConfig(algo=PPOConfig(hidden=(16,)), action=AdviseAction(), env=ENV)


@pytest.fixture
def written(tmp_path: Path) -> Path:
    torch.manual_seed(1)
    path = tmp_path / "calm.pt"
    zoo.write(path, CONFIG, make_algorithm(CONFIG.algo, CONFIG.action, CONFIG.env).policy)
    return path


def test_a_policy_comes_back_with_what_it_is_played_with(written: Path) -> None:
    torch.manual_seed(1)
    original = make_algorithm(CONFIG.algo, CONFIG.action, CONFIG.env).policy.state_dict()
    found = zoo.read(written)
    assert found.name == "calm"
    assert found.env == EnvConfig(hold_s=3.0), "episodes are whole, and emit what evaluations read"
    assert found.action == AdviseAction() and found.algo == CONFIG.algo
    restored = found.policy.state_dict()
    assert restored.keys() == original.keys()
    assert all(torch.equal(restored[name], original[name]) for name in original)
    assert not found.policy.training


def test_a_file_cannot_name_code(written: Path, here: Path, refused: Refused) -> None:
    (here / "evil.py").write_text("open('ran', 'w').close()\nclass Thing: ...\n")
    state = torch.load(written, weights_only=True)
    state["options"]["algo"]["name"] = "evil:Thing"
    torch.save(state, written)
    with pytest.raises(IzooError, match="a policy of algo=evil:Thing"):
        zoo.read(written)
    refused(evaluate.main, [f"policy={written}", "contexts=pcg", "out=out"], "a policy of algo=evil:Thing")
    assert not (here / "ran").exists() and not (here / "out").exists()


def test_every_shipped_policy_loads_and_has_its_card() -> None:
    assert set(zoo.names()) == set(HELD), "held to a figure below"
    for name in zoo.names():
        trained = zoo.load(name)
        candidate = as_policy(f"zoo:{name}", trained.env)
        assert candidate.name == name
        card = zoo.card(name)
        assert card.startswith(f"# {name}\n")
        for heading in ("Trained", "Evaluated", "Intended use and limits", "Licence"):
            assert f"\n## {heading}\n" in card, f"{name}: {heading}"
        assert "Not yet." not in card
        assert catalog.weights(name).stat().st_size < 700_000
        with pytest.raises(IzooError, match="other observations"):
            as_policy(f"zoo:{name}", EnvConfig(observed=tuple(trained.env.observed)[:-1]))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a small training run; decisions of 2 s, which are not the default."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    words = ["contexts=pcg_easy", "action=advise", "env.horizon_s=75", "env.hold_s=2", "algo.hidden=[16]"]
    words += ["total_frames=100", "algo.frames_per_batch=100", "evaluation.contexts=0"]
    assert train.main([*words, "num_workers=1", "collector=single", f"run_dir={folder}"]) == 0
    return folder


@pytest.fixture(scope="module")
def exported(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("shelf") / "mine.pt"
    assert ZOO.main(["export", str(run), "--out", str(path)]) == 0
    return path


def test_a_run_is_exported_with_a_card_and_plays_as_it_did(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    out = tmp_path / "mine.pt"
    assert ZOO.main(["export", str(run), "--out", str(out)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"Play it: python -m izoo.evaluate policy={out}"
    card = (tmp_path / "mine.md").read_text()
    assert "python -m izoo.train algo=ppo action=advise contexts=pcg" in card and "algo.hidden=[16]" in card
    assert str(run.parent) not in card, "a card names no folder of a machine"

    there, trained = run_folder.load_algorithm(run)[0].policy.eval(), zoo.read(out)
    seen = torch.rand(4, 8, len(observation_names(trained.env)))
    batch = TensorDict({"agents": {"observation": seen, "mask": torch.ones(4, 8, dtype=torch.bool)}}, [4])
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        acted = [policy(batch.clone())["agents", "action"] for policy in (there, trained.policy)]
    assert torch.equal(*acted)
    refused(ZOO.main, ["export", str(run), "--out", str(out)], "exists already")
    words = ["export", str(run), "--out", str(tmp_path / "other.pt"), "--evaluation", str(tmp_path)]
    refused(ZOO.main, words, "is not a results folder")
    assert not (tmp_path / "other.pt").exists()
    results = folder(tmp_path / "results", table({"mine": (0.06, -1.0, 1)}))
    assert ZOO.main([*words[:-1], str(results)]) == 0
    card = (tmp_path / "other.md").read_text()
    assert "| CO2 saved, over uncommanded | +6." in card and "mine saves 6." in card


@pytest.mark.parametrize(
    "words",
    [
        ("contexts=pcg", "contexts.lane_count={1:0.25,2:0.75}", "contexts.exclude=[{lane_count:[2,3],green_s:26..29}]"),
        ("contexts=mixed", "contexts.sources=[{name:city,city:atlanta},{name:dataset,path:/home/me/secret}]"),
        ("contexts=city", "contexts.city=atlanta", "contexts.split=all", "start=/home/me/secret"),
        ("task=busy_lane", "algo=ppo_vehicle", "env.lane_change=false", "algo.hidden=[16,16]"),
    ],
)
def test_the_command_on_a_card_can_be_run(words: tuple[str, ...]) -> None:
    config = compose_config(TrainConfig, words)
    command = " ".join(_changed(config))
    assert "secret" not in command
    again = compose_config(TrainConfig, shlex.split(command))
    for name in ("algo", "action", "env", "simulator", "twin", "num_envs", "total_frames", "seed"):
        assert getattr(again, name) == getattr(config, name), name
    assert again.contexts.name == config.contexts.name
    assert again.contexts == config.contexts or "path:FOLDER" in command


def test_an_exported_policy_is_evaluated_and_replayed_as_its_run_is(
    run: Path, exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(exported.parent)
    words = ["contexts=pcg_easy", "num_contexts=1", "seeds=1", "env.horizon_s=300", "num_workers=0"]
    words += [f"cache={tmp_path / 'cache'}"]
    out, ours = tmp_path / "file", tmp_path / "run"
    assert evaluate.main(["policy=mine.pt", *words, f"out={out}"]) == 0
    assert evaluate.main([f"run={run}", *words, f"out={ours}"]) == 0
    tables = [read_table(folder) for folder in (out, ours)]
    own = zip(tables, ("mine", "run"), strict=True)
    driven = [table[table["policy"] == name].drop(columns="policy") for table, name in own]
    assert len(driven[0]) == 1 and driven[0].equals(driven[1].set_axis(driven[0].index))
    assert read_manifest(out).config("mine").hold_s == 2.0
    monkeypatch.chdir(tmp_path)
    assert report.main([str(out)]) == 0
    assert len(list((out / "replays").glob("*.gz"))) == 1, "the page found the file from another folder"


def test_an_exported_policy_is_an_entry_of_the_benchmarks(
    exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(exported.parent)
    lane = "{task: busy_lane, entries: [mine], contexts: 1}"
    (tmp_path / "mine.yaml").write_text(f"entries: {{mine: {{policy: mine.pt}}}}\nparts: {{lane: {lane}}}\n")
    run = PartRun(read_experiment(str(tmp_path / "mine.yaml")), "lane", tmp_path, CampaignConfig())
    monkeypatch.chdir(tmp_path)
    kind, mine = run.entries["mine"]
    assert (kind, mine.policy) == ("scripted", str(exported)), "a campaign goes on from any folder"
    own = run.env("mine")
    assert own.hold_s == 2.0 != run.env("human").hold_s and own.horizon_s == run.task.env.horizon_s
    named = as_policy(str(exported), own, "mine")
    assert named.record.weights == weights_hash(zoo.load(str(exported)).policy)
    assert twin.COMMAND.compose([f"policies=[glide,'{exported}']"]).env == zoo.read(exported).env


@pytest.mark.slow
def test_an_exported_policy_collects(run: Path, exported: Path, tmp_path: Path) -> None:
    """And so does a checkpoint, whose file ends like it."""
    words = ["contexts=pcg_easy", "frames=20", "env.horizon_s=75", "num_workers=1"]
    assert collect.main([f"policy={exported}", *words, f"out={tmp_path / 'file'}"]) == 0
    (newest,) = (run / "checkpoints").glob("step-*.pt")
    assert collect.main([f"policy={newest}", *words, f"out={tmp_path / 'checkpoint'}"]) == 0


HELD = {"busy_lane_arrive": 103.8793, "busy_lane_glide": 99.4210, "busy_lane_imitation": 105.3905}
HELD |= {"measured_search": 102.5594, "salt_lake_city_glide": 102.6634}
"""CO2 of all vehicles that crossed, g per vehicle, in one episode of 1,000 s."""
UNCOMMANDED = 107.1335
FIGURES = {f"zoo:{name}": grams for name, grams in HELD.items()} | {"uncommanded": UNCOMMANDED}


@pytest.mark.parametrize("policy", FIGURES)
def test_a_shipped_policy_drives_as_it_did(policy: str) -> None:
    features = {"inflow_vph_per_lane": 500, "green_s": 23, "red_s": 28, "adoption": 0.5}
    context = procedural_context(lane_count=1, phase_count=1, **features)
    env = zoo.load(policy.removeprefix("zoo:")).env if policy.startswith("zoo:") else zoo.load("measured_search").env
    with contextlib.closing(EcoDrivingEnv(context, config=dataclasses.replace(env, horizon_s=1000.0))) as played:
        state, acting = played.reset(seed=11), as_policy(policy, env).policy
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            while not bool(state["done"]):
                state = played.step_lean(acting(state))
    counted = state["metrics", "approach"]
    assert float(counted["emission_g"].sum() / counted["crossed"].sum()) == pytest.approx(FIGURES[policy], rel=1e-3)


def test_shipped_policies_burn_less_than_uncommanded_cvs() -> None:
    assert all(grams < UNCOMMANDED for grams in HELD.values())


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"format": "izoo-policy-0"}, "not a policy of format"),
        ([1, 2], "not a policy of format"),
        ({"format": "izoo-policy-1"}, "cannot read .*options"),
        ({"format": "izoo-policy-1", "options": {"algo": {"name": "pqo"}}}, "hold a policy of algo=pqo"),
        ({"format": "izoo-policy-1", "options": {"algo": {"name": "ppo"}}}, "cannot read .*action"),
        (None, r"other\.pt; give one that python -m izoo\.zoo export wrote"),
    ],
)
def test_other_files_are_refused(state: object, message: str, tmp_path: Path, refused: Refused) -> None:
    path = tmp_path / "other.pt"
    if state is not None:
        torch.save(state, path)
    assert re.search(message, refused(evaluate.main, [f"policy={path}", "contexts=pcg", f"out={tmp_path / 'out'}"]))
    assert not (tmp_path / "out").exists()


def test_nothing_in_a_file_is_run(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[object, tuple[object, ...]]:
            return (Path.touch, (tmp_path / "ran",))

    path = tmp_path / "trap.pt"
    torch.save({"format": "izoo-policy-1", "options": Trap()}, path)
    with pytest.raises(IzooError, match="cannot read"):
        zoo.read(path)
    assert not (tmp_path / "ran").exists()
