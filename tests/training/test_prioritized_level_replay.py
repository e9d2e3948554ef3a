"""Prioritised level replay: what is drawn, what scores, and that a run is the same whatever the threads."""

import contextlib
import copy
from pathlib import Path

import numpy as np
import pytest
import torch

from izoo import train
from izoo.algos.drivers.uncommanded import UncommandedDriver
from izoo.algos.learners.base import EPISODES
from izoo.algos.learners.mappo import TEAM_BASELINE
from izoo.conf.train_options import LevelsConfig
from izoo.contexts.procedural import ProceduralSource
from izoo.contexts.source import RandomSchedule
from izoo.envs.mdp.frame import TEAM_REWARD
from izoo.training import baseline_episodes, checkpoint
from izoo.training.baseline_episodes import BaselineComparison
from izoo.training.collectors import BatchSource
from izoo.training.prioritized_level_replay import PrioritizedLevelReplay, replay_probabilities
from tests.training.test_baseline_episodes import config as paired_config
from tests.training.test_baseline_episodes import schedule as uniform


def make(seed: int = 0, **options: object) -> PrioritizedLevelReplay:
    draws = RandomSchedule(ProceduralSource({"adoption": 0.5}), 5)
    return PrioritizedLevelReplay(draws, LevelsConfig(draw="prioritised", **options), seed)  # type: ignore[arg-type]


def play(levels: PrioritizedLevelReplay, episode: int, score: float) -> int:
    """Play an episode of two decisions and three slots, whose mean absolute advantage is ``score``."""
    level = levels.level(episode)
    mask = torch.tensor([[[True, True, False], [True, False, False]]])
    advantage = torch.tensor([[[score, -score, float("nan")], [score, 1e9, -1e9]]])
    levels.update(torch.full((1, 2), episode), advantage, mask, torch.tensor([[False, True]]))
    return level


def test_probabilities_by_hand() -> None:
    """Ranks 2, 1, 3; ages 0, 3, 1."""
    found = replay_probabilities(np.array([5.0, 7.0, 1.0]), np.array([0, 3, 1]), 0.5, 0.2)
    by_score = np.array([1 / 4, 1.0, 1 / 9]) / (1 / 4 + 1.0 + 1 / 9)
    np.testing.assert_allclose(found, 0.8 * by_score + 0.2 * np.array([0.0, 3.0, 1.0]) / 4.0)
    np.testing.assert_allclose(replay_probabilities(np.ones(2), np.zeros(2), 1.0, 1.0), [0.5, 0.5])


def test_scores_are_means_over_the_slots_that_hold_a_cv() -> None:
    levels = make()
    assert play(levels, 0, 2.5) == 0 and levels.scores == {0: 2.5}
    positive = make(score="positive")
    play(positive, 0, 3.0)
    assert positive.scores[0] == pytest.approx(2.0), "3, 0 and 3"
    nobody = make()
    nobody.level(0)
    none = torch.zeros(1, 1, 3, dtype=torch.bool)
    nobody.update(torch.zeros(1, 1, dtype=torch.int64), torch.full((1, 1, 3), float("nan")), none, none[..., 0] | True)
    assert nobody.scores == {}


def test_an_episode_is_scored_over_all_its_batches_once_it_ends() -> None:
    levels = make()
    levels.draw([0, 1])
    mask, numbers = torch.ones(2, 2, 1, dtype=torch.bool), torch.tensor([[0, 0], [1, 1]])
    going = torch.zeros(2, 2, dtype=torch.bool)
    levels.update(numbers, torch.tensor([[1.0, 1.0], [5.0, 5.0]])[..., None], mask, going)
    assert levels.scores == {}
    ended = torch.tensor([[True, False], [False, False]])
    following = torch.tensor([[0, 2], [1, 1]])
    levels.draw([2])
    levels.update(following, torch.tensor([[4.0, 9.0], [5.0, 5.0]])[..., None], mask, ended)
    assert levels.scores == {0: 2.0}


def test_new_levels_come_in_order_until_half_are_known_and_then_in_their_share() -> None:
    levels = make(kept=40, share=0.3, temperature=1.0)
    numbers = [play(levels, episode, float(levels.level(episode) % 7)) for episode in range(1000)]
    assert numbers[:20] == list(range(20))
    assert levels.replayed / (1000 - 20) == pytest.approx(0.3, abs=0.05)
    assert sorted(set(numbers)) == list(range(1000 - levels.replayed)), "no new level is left out"
    assert len(levels.scores) == 40 and set(levels.scores.values()) == {6.0}, "those with the greatest scores are kept"


def test_a_level_under_way_is_not_drawn_beside() -> None:
    levels = make(kept=2, share=1.0)
    for episode in range(2):
        play(levels, episode, 1.0)
    levels.draw(range(2, 6))
    drawn = [levels.level(episode) for episode in range(2, 6)]
    assert sorted(drawn[:2]) == [0, 1] and drawn[2:] == [2, 3]


def test_state_restores_the_very_next_draws() -> None:
    one = make(kept=10, temperature=1.0)
    for episode in range(30):
        play(one, episode, float(episode % 5))
    one.draw([30, 31])
    other = make(kept=10, temperature=1.0)
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    for episode in range(30, 90):
        assert play(one, episode, float(episode % 3)) == play(other, episode, float(episode % 3))
    assert one.state_dict() == other.state_dict() and one.replayed > 10


@pytest.mark.slow
def test_what_is_compared_is_the_level_that_is_played(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Uncommanded training, with replays: the same rewards as the uncommanded episodes beside it, step by step."""
    monkeypatch.setattr(baseline_episodes, "BLOCK", 4)
    options = paired_config("levels.draw=prioritised")
    draws = uniform(options)
    levels = PrioritizedLevelReplay(draws, LevelsConfig(draw="prioritised", kept=4, share=0.7), 0)
    replays = 0
    with (
        contextlib.closing(BatchSource(options, UncommandedDriver(), levels)) as source,
        contextlib.closing(BaselineComparison(options, draws, tmp_path, levels.level)) as beside,
    ):
        for _ in range(16):
            batch = source.next().clone()
            beside.add(batch)
            torch.testing.assert_close(batch["next", TEAM_BASELINE], batch["next", TEAM_REWARD], rtol=0.0, atol=0.0)
            beside.compare(batch)
            numbers = batch[EPISODES][..., 0]
            replays += sum(levels.level(number) != number for number in numbers.unique().tolist())
            mask = batch["agents", "mask"]
            levels.update(numbers, torch.rand(mask.shape), mask, batch["next", "done"].squeeze(-1))
    assert replays > 5 and levels.replayed > 2


TOY = [
    *("contexts=pcg_easy", "contexts.adoption=1.0", "env.horizon_s=70", "simulator=twin", "num_envs=4", "algo.lr=1e-2"),
    *("algo.hidden=[8]", "algo.frames_per_batch=200", "algo.minibatch_rows=128", "evaluation.contexts=0"),
    *("validation.every_batches=0", "total_frames=3000", "levels.draw=prioritised", "levels.kept=6"),
    "levels.share=0.6",
]


@pytest.mark.slow
def test_a_run_is_the_same_whatever_the_threads_and_another_without_replay(tmp_path: Path) -> None:
    words = {"one": ["twin.threads=1"], "two": ["twin.threads=2"], "uniform": ["levels.draw=uniform"]}
    state = {}
    for name, more in words.items():
        given = {word.partition("=")[0] for word in more}
        toy = [word for word in TOY if word.partition("=")[0] not in given]
        assert train.main([*toy, *more, f"run_dir={tmp_path / name}"]) == 0
        state[name] = checkpoint.load(checkpoint.find(tmp_path / name))
    assert state["one"]["levels"] == state["two"]["levels"]
    begun, replayed, _ = state["one"]["levels"]["counts"]
    assert begun > 20 and replayed >= 5
    one, two, other = (state[name]["algorithm"]["policy"] for name in words)
    assert all(torch.equal(leaf, two[key]) for key, leaf in one.items())
    assert not all(torch.equal(leaf, other[key]) for key, leaf in one.items())
    # With another number of environments what is known of the levels stays.
    assert train.main([f"resume={tmp_path / 'one'}", "num_envs=5", "total_frames=3600"]) == 0
    later = checkpoint.load(checkpoint.find(tmp_path / "one"))["levels"]
    assert later["counts"][0] > begun and later["counts"][1] >= replayed
