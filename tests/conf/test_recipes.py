"""``recipe=NAME``: whole sets of options that go together."""

from __future__ import annotations

import pytest

from izoo import evaluate, train
from izoo.cli.entries import TRAIN
from izoo.conf.compose import compose_config
from izoo.conf.recipes import RECIPES
from izoo.conf.train_options import TrainConfig
from izoo.training.option_checks import check_options


def composed(*words: str) -> TrainConfig:
    return compose_config("train", TrainConfig, TRAIN.options(list(words)))


@pytest.mark.parametrize("name", RECIPES)
def test_every_recipe_says_something_and_its_contexts_are_none_of_the_test_box(name: str) -> None:
    config = composed(f"recipe={name}")
    assert config != TrainConfig()
    assert all(word.partition("=")[1] for word in RECIPES[name][1])
    assert config.evaluation.contexts >= 16
    if getattr(config.algo, "warm_start", "none") != "none":
        assert config.algo.warm_start_frames <= config.total_frames  # type: ignore[attr-defined]
    check_options(config)


def test_other_words_change_a_recipe_wherever_they_stand() -> None:
    before, after = composed("seed=3", "num_envs=4", "recipe=busy_lane"), composed("recipe=busy_lane", "num_envs=4")
    assert before.num_envs == after.num_envs == 4
    assert before.seed == 3 and before.algo == after.algo


def test_another_choice_takes_the_place_of_all_that_the_recipe_says_of_it() -> None:
    changed = composed("recipe=busy_lane", "contexts=city", "algo=mappo", "action=direct")
    assert changed.contexts.name == "city" and changed.algo.name == "mappo"
    assert changed.algo.control_variate == "none"  # type: ignore[attr-defined]
    assert (changed.env.decide, changed.env.action) == ("step", "acceleration")
    arriving = composed("recipe=busy_lane", "action=arrive")
    assert (arriving.env.decide, arriving.env.action_size, arriving.action.initial) == ("vehicle", 2, 0.25)  # type: ignore[union-attr]
    assert changed.simulator == "twin"


@pytest.mark.parametrize("words", [("env.reward=paper", "env.reward.eta=0.5"), ("env.reward=fuel",)])
def test_another_reward_is_whole(words: tuple[str, ...]) -> None:
    """The recipe's own weight on lost time belongs to the recipe's reward."""
    assert composed("recipe=city").env.reward.delay == -0.2
    assert composed("recipe=city", *words).env.reward == composed(*words).env.reward
    assert composed("recipe=city", "env.reward.delay=-0.5").env.reward.delay == -0.5


def test_unknown_recipes_and_commands_without_recipes_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert train.main(["recipe=busy_road"]) == 2
    assert "busy_lane" in capsys.readouterr().err
    assert evaluate.main(["recipe=busy_lane", "policy=glide"]) == 2
    assert "unknown option 'recipe'" in capsys.readouterr().err


def test_help_names_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert train.main(["--help"]) == 0
    assert "recipe=busy_lane: one-lane approaches near capacity" in capsys.readouterr().out
