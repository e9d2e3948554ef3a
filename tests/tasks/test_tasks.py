"""Tasks: names, roles and other conditions."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo import tasks
from izoo.algos.learners.ddpg import DDPGConfig
from izoo.algos.learners.ppo import PPOConfig
from izoo.algos.learners.registry import make_algorithm
from izoo.contexts.cities.rebuilt import CITIES
from izoo.contexts.cities.weather import WEATHER_PUBLISHED, weather
from izoo.contexts.procedural import SYSTEMATICITY_TEST_SAMPLE
from izoo.envs import EnvConfig, RewardConfig
from izoo.envs.mdp.frame import observation_names
from izoo.errors import IzooError

IN_TOWN = [name for name in tasks.names() if "measured" not in name]
MINE = dataclasses.replace(tasks.make("busy_lane"), name="mine")
NO_TASK = 3


def test_the_named_tasks_are_these() -> None:
    single = {"busy_lane", "systematicity", "measured", "salt_lake_city_to_atlanta", "measured_to_atlanta", *CITIES}
    assert set(tasks.names()) == single | {f"{name}_paper" for name in single}
    for name, task in tasks.tasks().items():
        assert task.name == name and task.about and task.learns


@pytest.mark.parametrize("name", IN_TOWN)
def test_test_sets_are_the_same_whenever_they_are_drawn(name: str) -> None:
    task = tasks.make(name)
    drawn = task.test_set(3)
    assert [context.content_hash for context in drawn] == [context.content_hash for context in task.test_set(3)]
    assert {context.content_hash for context in drawn} <= {context.content_hash for context in task.test_set()}


@pytest.mark.parametrize("city", CITIES)
def test_a_city_is_trained_on_and_tested_on_other_intersections(city: str) -> None:
    task = tasks.make(city)
    roles = [task.train.build(), task.validation.build(), task.test.build()]
    towns = [{source.locate(index)[0].intersection for index in range(len(source))} for source in roles]
    assert not (towns[0] & towns[1] or towns[0] & towns[2] or towns[1] & towns[2])
    context = roles[2][0]
    assert (context.adoption, context.hour, context.engine) == (1 / 3, "peak", "combustion")
    assert context.approach is not None
    assert (context.temperature_c, context.humidity_pct) == WEATHER_PUBLISHED.get(city, weather(city, "summer"))


def test_systematicity_is_tested_inside_a_box_that_training_excludes() -> None:
    hashes = {context.content_hash for context in SYSTEMATICITY_TEST_SAMPLE.interval_ends()}
    task = tasks.make("systematicity")
    assert {context.content_hash for context in task.test_set()} <= hashes and len(hashes) == 128
    drawn = [task.train.build().sample(np.random.default_rng(seed)) for seed in range(100)]
    assert not hashes & {context.content_hash for context in drawn}


def test_the_paper_form_has_the_papers_decisions_and_reward_and_every_intersection() -> None:
    task = tasks.make("salt_lake_city_to_atlanta_paper")
    assert (task.env.decide, task.env.action, task.action.name) == ("step", "acceleration", "direct")
    assert task.env.reward == RewardConfig.paper() and task.env.horizon_s == EnvConfig().horizon_s
    assert task.train.split == task.test.split == "all"  # type: ignore[union-attr]
    assert (task.train.city, task.test.city) == ("salt_lake_city", "atlanta")  # type: ignore[union-attr]


@pytest.mark.parametrize("config", [PPOConfig.paper(), DDPGConfig.paper()])
def test_in_the_paper_form_an_untrained_policy_commands_the_middle_of_the_papers_range(config: Any) -> None:
    env = EnvConfig()
    policy = make_algorithm(config, tasks.make("salt_lake_city_paper").action, env).policy
    shape = (2, env.num_agents)
    observation = torch.zeros(*shape, len(observation_names(env)))
    state = TensorDict({"agents": {"observation": observation, "mask": torch.ones(shape).bool()}}, [2])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.allclose(policy(state)["agents", "action"], torch.tensor(-5.0))


def test_other_conditions_hold_in_every_role_and_stand_in_the_name(tmp_path) -> None:
    task = tasks.make("measured_to_atlanta", adoption=0.1, cv_vehicle="human", path=str(tmp_path))
    assert task.name == "measured_to_atlanta, adoption=0.1, cv_vehicle=human"
    assert {(role.adoption, role.cv_vehicle) for role in (task.train, task.validation, task.test)} == {(0.1, "human")}
    assert task.train.path == task.validation.path == str(tmp_path)
    with pytest.raises(IzooError, match="reads no folder"):
        tasks.make("atlanta", path=str(tmp_path))


def test_tasks_of_ones_own_need_no_registry() -> None:
    assert tasks.make(f"{__name__}:MINE", adoption=1.0).name == "mine, adoption=1"
    for name, reason in ((f"{__name__}:NO_TASK", "is a int"), ("no_such:X", "No module"), ("busy", "Did you mean")):
        with pytest.raises(IzooError, match=reason):
            tasks.make(name)
