"""Trained policies that ship: read and written, refused where damaged, exported from a run, and played."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo import train, zoo
from izoo.algos.action import AdviseAction
from izoo.algos.ppo_config import PPOConfig
from izoo.algos.registry import make_algorithm
from izoo.commands.zoo_policies import ZOO
from izoo.conf.train_options import TrainConfig
from izoo.contexts.procedural import procedural_context
from izoo.envs import EcoDrivingEnv
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.errors import IzooError
from izoo.evaluation.policies import as_candidate
from izoo.zoo import shelf

CONFIG = TrainConfig(
    algo=PPOConfig(hidden=(16,)), action=AdviseAction(), env=EnvConfig(horizon_s=75.0, hold_s=3.0, emit=())
)


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


def test_one_changed_byte_is_noticed(written: Path) -> None:
    content = bytearray(written.read_bytes())
    content[len(content) // 2] ^= 1
    written.write_bytes(content)
    with pytest.raises(IzooError, match=r"calm\.pt .*(damaged|cut short)"):
        zoo.read(written)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"format": "izoo-policy-0"}, "not a policy of this version"),
        ([1, 2], "not a policy of this version"),
        ({"format": "izoo-policy-1"}, "can build: 'options'"),
        ({"format": "izoo-policy-1", "options": {"algo": {"name": "pqo"}}}, "can build"),
    ],
)
def test_other_files_are_refused(state: object, message: str, tmp_path: Path) -> None:
    path = tmp_path / "other.pt"
    torch.save(state, path)
    with pytest.raises(IzooError, match=message):
        zoo.read(path)


def test_weights_of_other_networks_are_refused(written: Path) -> None:
    state = torch.load(written, weights_only=True)
    state["options"]["algo"]["hidden"] = [17]
    torch.save(state, written)
    with pytest.raises(IzooError, match=r"can build: Error.* in loading state_dict"):
        zoo.read(written)


def test_nothing_in_a_file_is_run(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[object, tuple[object, ...]]:
            return (Path.touch, (tmp_path / "ran",))

    path = tmp_path / "trap.pt"
    torch.save({"format": "izoo-policy-1", "options": Trap()}, path)
    with pytest.raises(IzooError, match="not a policy"):
        zoo.read(path)
    assert not (tmp_path / "ran").exists()


def test_unknown_names_are_refused_with_those_there_are() -> None:
    with pytest.raises(IzooError, match="zoo:nobody"):
        zoo.load("nobody")
    with pytest.raises(IzooError, match="zoo:nobody"):
        as_candidate("zoo:nobody", EnvConfig())
    assert zoo.named("glide") is None


def test_every_shipped_policy_loads_and_has_its_card() -> None:
    assert zoo.names(), "the shelf is empty"
    for name in zoo.names():
        trained = zoo.load(name)
        candidate = as_candidate(f"zoo:{name}", trained.env)
        assert candidate.name == name
        card = zoo.card(name)
        assert card.startswith(f"# {name}\n")
        for heading in ("Trained", "Evaluated", "Intended use and limits", "Licence"):
            assert f"\n## {heading}\n" in card, f"{name}: {heading}"
        assert "Not yet." not in card
        assert shelf.weights(name).stat().st_size < 500_000
        with pytest.raises(IzooError, match="other observations"):
            as_candidate(f"zoo:{name}", EnvConfig(observed=tuple(trained.env.observed)[:-1]))


def test_a_run_is_exported_with_a_card_and_plays_as_it_did(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, out = tmp_path / "run", tmp_path / "shelf"
    out.mkdir()
    words = ["contexts=pcg_easy", "action=advise", "env.horizon_s=75", "algo.hidden=[16]", "total_frames=100"]
    words += ["algo.frames_per_batch=100", "evaluation.contexts=0", "num_workers=1", "collector=single"]
    assert train.main([*words, f"run_dir={run}"]) == 0
    assert ZOO.main(["export", str(run), "--out", str(out / "mine.pt")]) == 0
    card = (out / "mine.md").read_text()
    assert "python -m izoo.train action=advise contexts=pcg" in card and "algo.hidden=[16]" in card
    assert str(tmp_path) not in card, "a card names no folder of a machine"
    from izoo.training import runs

    there, trained = runs.load_policy(run), zoo.read(out / "mine.pt")
    seen = torch.rand(4, 8, len(observation_names(trained.env)))
    from tensordict import TensorDict

    batch = TensorDict({"agents": {"observation": seen, "mask": torch.ones(4, 8, dtype=torch.bool)}}, [4])
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        acted = [policy(batch.clone())["agents", "action"] for policy in (there, trained.policy)]
    assert torch.equal(*acted)
    assert ZOO.main(["export", str(run), "--out", str(out / "mine.pt")]) == 2
    assert "exists already" in capsys.readouterr().err


HELD = {"busy_lane_imitation": 105.3357, "busy_lane_search": 103.3743, "measured_search": 102.5594}
"""CO2 of all vehicles that crossed, g per vehicle, in one episode of 1,000 s; uncommanded CVs: 107.1335."""


def grams_per_vehicle(policy: str, env: EnvConfig) -> float:
    context = procedural_context(
        lane_count=1, phase_count=1, inflow_vph_per_lane=500, green_s=23, red_s=28, adoption=0.5
    )
    with contextlib.closing(EcoDrivingEnv(context, config=dataclasses.replace(env, horizon_s=1000.0))) as played:
        state = played.reset(seed=11)
        acting = as_candidate(policy, env).policy
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            while not bool(state["done"]):
                state = played.step_lean(acting(state))
    counted = state["metrics", "approach"]
    return float(counted["emission_g"].sum() / counted["crossed"].sum())


@pytest.mark.parametrize("name", HELD)
def test_a_shipped_policy_drives_as_it_did(name: str) -> None:
    env = zoo.load(name).env
    assert grams_per_vehicle(f"zoo:{name}", env) == pytest.approx(HELD[name], rel=1e-3)
    assert HELD[name] < grams_per_vehicle("uncommanded", env)
    assert set(HELD) == set(zoo.names())
