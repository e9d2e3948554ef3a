"""A run that was killed and resumed ends where an uninterrupted one does."""

import dataclasses
import os
import shutil
import signal
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase

from izoo import train
from izoo.algos.learners.base import ACTION, MASK
from izoo.cli.option_command import compose_config
from izoo.conf.train_options import TrainConfig
from izoo.contexts.procedural import procedural_context
from izoo.envs.config import EnvConfig
from izoo.envs.env import EcoDrivingBase
from izoo.envs.mdp.frame import TOTALS
from izoo.errors import IzooError
from izoo.training import checkpoint, run_folder
from izoo.training.command_replay import EpisodeHistories, EpisodeHistory
from izoo.training.environments import TrainingEnv, training_class
from tests.conftest import Refused
from tests.training import toy
from tests.training.toy import begun

TOY = [
    *("contexts=pcg_easy", "contexts.inflow_vph_per_lane=600", "contexts.adoption=1.0", "env.horizon_s=100"),
    *("algo.frames_per_batch=200", "algo.minibatch_rows=64", "evaluation.contexts=0", "checkpoint.every_batches=1"),
    *("total_frames=1200", "validation.every_batches=0", "algo.hidden=[16]"),
]
"""Episodes of 150 steps and batches of 100 or 200: runs are interrupted in the middle of episodes."""
TWIN = ["simulator=twin", "num_envs=4", "twin.threads=2", "twin.compare_every=4"]
TEAM = ["algo=mappo", "algo.credit=team", "algo.control_variate=team", "env.reward=fuel_team", "algo.value_norm=popart"]
"""What a run may hold besides networks: statistics of value targets, and the uncommanded episodes beside it."""
DDPG = ["algo=ddpg", "algo.learning_starts=200", "algo.replay_rows=2000"]
LEVELS = ["levels.draw=prioritised", "levels.kept=2", "levels.share=0.7"]
ONCE = ["action=speed", "env.action=speed", "env.decide=vehicle", "algo.control_variate=vehicle", "env.reward=fuel"]
ONCE += ["algo.common_noise=0.5"]
TD3 = ["algo=td3", "action=advise", "algo.learning_starts=200", "algo.replay_rows=2000"]


def flat(state: object, prefix: str = "") -> dict[str, object]:
    """Every leaf of nested containers by its path."""
    if isinstance(state, dict):
        items = state.items()
    elif isinstance(state, (list, tuple)):
        items = enumerate(state)  # type: ignore[assignment]
    else:
        return {prefix: state}
    return {path: leaf for key, value in items for path, leaf in flat(value, f"{prefix}/{key}").items()}


def kill_in_batch(run_dir: Path, words: list[str], batch: int, frames_per_batch: int = 200) -> None:
    """Start a run and kill it with SIGKILL once ``batch - 1`` checkpoints are written; again where it was over."""
    awaited = checkpoint.folder_of(run_dir) / f"step-{(batch - 1) * frames_per_batch:012d}.pt"
    for _ in range(3):
        shutil.rmtree(run_dir, ignore_errors=True)
        process = begun(run_dir, words, awaited.exists)
        os.killpg(process.pid, signal.SIGKILL)
        _, error = process.communicate(timeout=30)
        assert awaited.exists(), error
        if checkpoint.load(checkpoint.find(run_dir))["frames"] < 1200:
            return
    pytest.fail("the run was over before it was killed")


WARM = ["action=advise", "algo.warm_start=glide", "algo.warm_start_frames=400"]
"""Killed after its imitation, which is a part of its state."""
KILLED = {
    "single-ppo": ["collector=single"],
    "twin-warm-start": ["simulator=twin", "num_envs=4", *WARM],
    "parallel-ddpg": ["collector=parallel", "num_workers=2", *DDPG],
    "twin-levels": [*TWIN, *TEAM, *LEVELS],
    "twin-td3": [*TWIN, *TD3],
    "twin-once-per-vehicle": [*TWIN, "algo=gcrl", *ONCE],
    "parallel-once-per-vehicle": ["collector=parallel", *ONCE[:3]],
}


@pytest.mark.slow
@pytest.mark.parametrize("words", KILLED.values(), ids=KILLED)
def test_a_killed_and_resumed_run_ends_like_an_uninterrupted_one(words: list[str], tmp_path: Path) -> None:
    words = [*TOY, *words]
    if words[-1] in (*DDPG, *TD3):
        words = [word for word in words if not word.startswith("algo.minibatch_rows")]
    assert train.main([*words, f"run_dir={tmp_path / 'a'}"]) == 0
    kill_in_batch(tmp_path / "b", words, batch=4)
    assert train.main([f"resume={tmp_path / 'b'}"]) == 0
    whole, resumed = (flat(checkpoint.load(checkpoint.find(tmp_path / name))) for name in "ab")
    assert whole.keys() == resumed.keys()
    for path, leaf in whole.items():
        if isinstance(leaf, torch.Tensor):
            assert torch.equal(leaf, resumed[path]), path  # type: ignore[arg-type]
        elif not path.endswith("/seconds"):
            assert leaf == resumed[path], path


def test_a_run_that_is_resumed_further_back_gives_up_later_checkpoints_once_it_has_one_of_its_own(
    trained: Path, tmp_path: Path
) -> None:
    run_dir = shutil.copytree(trained, tmp_path / "run")
    (first,) = checkpoint.listed(run_dir)
    for total, kept in ((100, [50, 100]), (150, [50, 150]), (50, [50])):
        assert train.main([f"resume={first}", f"total_frames={total}", "checkpoint.every_batches=5"]) == 0
        assert [checkpoint.frames_of(path) for path in checkpoint.listed(run_dir)] == kept


def test_an_option_that_is_changed_leaves_the_others_of_its_group_as_they_were(tmp_path: Path) -> None:
    words = ["simulator=twin", "num_envs=4", "twin.stagger=false", "validation.contexts=3"]
    stored = compose_config(TrainConfig, [*words, "validation.every_batches=0"])
    run_folder.write_config(tmp_path, stored)
    changed = ["twin.threads=1", "validation.every_batches=2", "num_envs=5", "collector=parallel"]
    found = train.COMMAND.compose([f"resume={tmp_path}", *changed])
    assert (found.resume, found.run_dir) == (str(tmp_path), str(tmp_path))
    assert found.twin == dataclasses.replace(stored.twin, threads=1)
    assert (found.validation.every_batches, found.validation.contexts, found.num_envs) == (2, 3, 5)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["device=cuda"], "device=cuda, but PyTorch finds no GPU"),
        (["twin.surrogate=cuda"], "twin.surrogate=cuda, but PyTorch finds no GPU"),
        (["num_envs=6"], "policies play the same episodes side by side"),
        (["run_dir=elsewhere"], "a resumed run stays in its folder; leave run_dir out."),
    ],
)
def test_a_refused_resumption_leaves_the_run_as_it_was(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    search = ["algo=cmaes", "algo.population=4", "simulator=twin", "num_envs=4", "env.reward=fuel_team"]
    run_folder.write_config(tmp_path, compose_config(TrainConfig, search))
    before = (tmp_path / run_folder.CONFIG_FILE).read_bytes()
    refused(train.main, [f"resume={tmp_path}", *words, "total_frames=900000"], message)
    assert (tmp_path / run_folder.CONFIG_FILE).read_bytes() == before


DENSE = procedural_context(adoption=1.0, inflow_vph_per_lane=900.0, lane_length_m=120.0)
ENV = EnvConfig(horizon_s=100.0, num_agents=16, emit=())
SLOTS = 16


def play(
    env: EcoDrivingBase, root: TensorDictBase, steps: int, generator: torch.Generator
) -> tuple[TensorDictBase, TensorDictBase]:
    """Step with random commands; return the steps ``[2, T]`` and the state to act on next."""
    frames = []
    for _ in range(steps):
        root.set(ACTION, torch.rand(2, SLOTS, 1, generator=generator) * 4.0 - 2.0)
        root.set(("agents", "defer"), torch.rand(2, SLOTS, generator=generator) < 0.2)
        step, root = env.step_and_maybe_reset(root)
        frames.append(step)
    return torch.stack(frames, 1), root


@pytest.mark.slow
@pytest.mark.parametrize("steps", [40, 150, 190])
def test_episodes_in_progress_are_lived_through_again(steps: int) -> None:
    """Within the first episode, between two, and within the second; one worker's episode is shorter."""
    histories = EpisodeHistories.fresh(2)
    first = training_class("sumo")(2, contexts=DENSE, config=ENV)
    batch, root = play(first, first.reset(), steps, torch.Generator().manual_seed(3))
    histories.add(batch)
    again = EpisodeHistories.from_state(histories.state_dict())
    assert [past.episode for past in again.histories] == ([0, 1] if steps < 150 else [2, 3])
    second = training_class("sumo")(2, contexts=DENSE, config=ENV, histories=again.histories)
    other = second.reset()
    for key in (MASK, ("agents", "observation"), ("agents", "vehicle")):
        assert torch.equal(root.get(key), other.get(key)), key
    # To the end of the episode, for its metrics, and into the next one.
    rest = 310 - steps
    both = ((first, root), (second, other))
    whole, resumed = (play(env, state, rest, torch.Generator().manual_seed(5))[0] for env, state in both)
    for key in (MASK, ("next", "agents", "observation"), ("next", "agents", "reward"), ("next", "done")):
        assert torch.equal(whole.get(key), resumed.get(key)), key
    ended = whole.get(("next", "done")).squeeze(-1)
    assert ended.any() and whole.get(MASK).any()
    assert torch.equal(whole.get(("next", TOTALS))[ended], resumed.get(("next", TOTALS))[ended])
    first.close()
    second.close()


@pytest.mark.parametrize("num_workers", [1, 2])
def test_the_next_episode_follows_the_one_in_progress(num_workers: int) -> None:
    """Of a single environment, or of one worker among several."""
    config = EnvConfig(horizon_s=60.0, num_agents=16, emit=("context",))
    env = TrainingEnv(DENSE, config=config, worker=0, num_workers=num_workers, histories=[EpisodeHistory(4)])
    try:
        state = env.reset()
        assert state["context", "episode"].item() == 4
        done = False
        while not done:
            state.set(ACTION, torch.zeros(16, 1))
            step, state = env.step_and_maybe_reset(state)
            done = bool(step["next", "done"])
        assert state["context", "episode"].item() == 4 + num_workers
    finally:
        env.close()


def test_an_episode_that_does_not_repeat_itself_is_refused() -> None:
    history = EpisodeHistory(5, torch.tensor([2]), {"action": torch.tensor([0.5, 1.0])})
    assert history.at(0, torch.tensor([True, False, True, False]))["action"].tolist() == [0.5, 0.0, 1.0, 0.0]
    with pytest.raises(IzooError, match="episode 5 does not repeat itself: 1 controlled vehicles at step 0, 2 before"):
        history.at(0, torch.tensor([True, False, False, False]))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of one batch, to be copied."""
    run_dir = tmp_path_factory.mktemp("trained") / "run"
    assert train.main([*toy.TOY, "total_frames=50", f"run_dir={run_dir}"]) == 0
    return run_dir


def test_a_run_that_was_moved_goes_on(trained: Path, tmp_path: Path) -> None:
    moved = shutil.copytree(trained, tmp_path / "elsewhere")
    assert train.main([f"resume={moved}", "total_frames=100"]) == 0
    assert checkpoint.load(checkpoint.find(moved))["frames"] == 100
    with pytest.raises(IzooError, match=r"is one checkpoint, so checkpoint=best chooses nothing"):
        checkpoint.find(checkpoint.find(moved), "best")


@pytest.mark.slow
def test_states_of_the_twin_that_others_saved_are_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Whatever they hold: compiled code would take them unchecked. The run itself goes on."""
    run_dir, words = tmp_path / "run", [word for word in toy.TOY if not word.startswith("collector")]
    assert train.main([*words, "simulator=twin", "num_envs=2", "twin.threads=1", f"run_dir={run_dir}"]) == 0
    state = checkpoint.load(checkpoint.find(run_dir))
    state["environments"]["packed"][0][5] ^= 0xFF
    torch.save(state, checkpoint.find(run_dir))
    assert train.main([f"resume={run_dir}", "total_frames=200"]) == 0
    assert "saved the episodes in progress, left out here" in capsys.readouterr().out
    assert train.main([f"resume={run_dir}", "total_frames=300"]) == 0
    assert "left out" not in capsys.readouterr().out


@pytest.mark.slow
def test_another_number_of_workers_leaves_the_episodes_in_progress_out(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    assert train.main([*TOY, "total_frames=400", f"run_dir={run_dir}"]) == 0
    assert train.main([f"resume={run_dir}", "total_frames=600", "num_workers=1"]) == 0
    state = checkpoint.load(checkpoint.find(run_dir))
    assert state["first_episode"] == 4, "two workers had reached the episodes 2 and 3"
    assert [entry["episode"] for entry in state["histories"]] == [1]
    assert run_folder.read_config(run_dir).num_workers == 1
