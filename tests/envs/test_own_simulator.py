"""A further simulator is a folder, here :mod:`tests.envs.toy_simulator`, and a line in ``izoo.envs.SIMULATORS``."""

from pathlib import Path

import pytest
from torchrl.envs.utils import check_env_specs

from izoo import envs, evaluate, train
from izoo.envs import EnvConfig, Simulator
from izoo.results import read_table
from izoo.training import checkpoint
from tests.envs.worlds import crossing


@pytest.fixture(autouse=True)
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    line = Simulator("the toy", "tests.envs.toy_simulator:ToyBackend", batched=True)
    monkeypatch.setitem(envs.SIMULATORS, "toy", line)


@pytest.mark.parametrize("n", [None, 3])
def test_its_environments_are_those_of_any_simulator(n: int | None) -> None:
    env = envs.make("toy", n, crossing(), EnvConfig(horizon_s=60.0), seed=3)
    check_env_specs(env)
    batch = env.rollout(60)
    assert batch["agents", "mask"].any() and batch["next", "vehicles", "speed_mps"].max() > 10.0
    env.close()


@pytest.mark.slow
def test_ppo_trains_on_it_and_its_policy_is_evaluated_there(tmp_path: Path) -> None:
    words = ["simulator=toy", "num_envs=2", "contexts=pcg_easy", "env.horizon_s=60", "algo.hidden=[8]"]
    words += ["algo.frames_per_batch=140", "total_frames=140", "evaluation.contexts=0", "twin.compare_every=1"]
    assert train.main([*words, f"run_dir={tmp_path / 'run'}"]) == 0
    assert checkpoint.frames_of(checkpoint.find(tmp_path / "run")) == 140
    words = ["simulator=toy", "num_contexts=1", "seeds=1", "env.horizon_s=60", f"out={tmp_path / 'out'}"]
    assert evaluate.main([f"run={tmp_path / 'run'}", *words]) == 0
    table = read_table(tmp_path / "out")
    assert set(table["simulator"]) == {"toy"} and set(table["policy"]) == {"run", "human", "uncommanded"}
    assert (table["cohort_left"] == table["cohort"]).all(), "nothing stops a vehicle here"
