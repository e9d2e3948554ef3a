"""Options, contexts and seeds of the generalization benchmark; nothing is simulated."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import pytest
import yaml

import izoo.conf
from izoo import zoo
from izoo.benchmarks.campaign.generalization_options import SCALES, GeneralizationConfig, parse_entry
from izoo.benchmarks.campaign.task_plan import (
    evaluation_env,
    evaluation_seeds,
    limit_contexts,
    make_plan,
    place_name,
    train_config,
)
from izoo.cli.compose import compose_config
from izoo.contexts import protocols
from izoo.contexts.procedural import procedural_context
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError
from izoo.zoo import catalog


def hashes(contexts) -> list[str]:  # type: ignore[no-untyped-def]
    return [context.content_hash for context in contexts]


def test_yaml_equals_dataclass() -> None:
    name = "benchmarks.generalization"
    assert compose_config(name, GeneralizationConfig, []) == GeneralizationConfig()
    given = yaml.safe_load((Path(izoo.conf.__path__[0]) / f"{name}.yaml").read_text())
    assert list(given) == [field.name for field in dataclasses.fields(GeneralizationConfig)], "all can be given"


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        ({}, protocols.in_distribution()),
        (
            {"protocol": "in_distribution", "train": "boston", "form": "paper"},
            protocols.in_distribution("boston", "paper"),
        ),
        ({"protocol": "productivity"}, protocols.productivity()),
        ({"protocol": "productivity", "test": "chicago"}, protocols.productivity(test="chicago")),
        ({"protocol": "systematicity"}, protocols.systematicity()),
        ({"protocol": "systematicity", "test_set": "sample"}, protocols.systematicity("sample")),
    ],
)
def test_contexts_are_those_of_the_protocols(options, wanted) -> None:  # type: ignore[no-untyped-def]
    import numpy as np

    plan = make_plan(GeneralizationConfig(scale="paper", **options).resolved())
    assert hashes(plan.test) == hashes(wanted.test)
    for seed in range(5):
        drawn = [source.sample(np.random.default_rng(seed)) for source in (plan.train.build(), wanted.train)]
        assert hashes(drawn)[0] == hashes(drawn)[1]


def test_a_larger_limit_contains_a_smaller_one() -> None:
    contexts = protocols.systematicity().test
    few, more = (limit_contexts(contexts, count) for count in (5, 20))
    assert set(hashes(few)) < set(hashes(more)) < set(hashes(contexts))
    assert hashes(few) == hashes(limit_contexts(contexts, 5))
    assert hashes(limit_contexts(contexts, 0)) == hashes(contexts)


def test_training_contexts_are_played_where_something_is_trained() -> None:
    cities, boxes = (
        [
            make_plan(GeneralizationConfig(protocol=protocol, train_contexts=count).resolved()).seen  # type: ignore[arg-type]
            for count in (3, 5)
        ]
        for protocol in ("in_distribution", "systematicity")
    )
    trained_on = hashes(protocols.in_distribution().train)  # type: ignore[arg-type]
    for few, more in (cities, boxes):
        assert len(few) == 3 and len(more) == 5 and set(hashes(few)) < set(hashes(more))
    assert set(hashes(cities[1])) < set(trained_on)
    nothing = ({"train_contexts": 0}, {"algos": ("glide",)}, {"form": "paper", "train": "boston"})
    assert all(make_plan(GeneralizationConfig(**options).resolved()).seen == [] for options in nothing)  # type: ignore[arg-type]


def test_measured_intersections_are_split(dataset) -> None:  # type: ignore[no-untyped-def]
    import os

    folder = f"{os.environ['IZOO_TEST_DATA']}/salt-lake-city-60"
    plan = make_plan(GeneralizationConfig(train=folder).resolved())
    assert plan.task == "salt-lake-city-60/ -> salt-lake-city-60/, 200 s"
    train = {context.intersection.name for context in plan.train.build()}  # type: ignore[attr-defined]
    test = {context.intersection.name for context in plan.test}
    assert test and train and not train & test
    assert all(context.approach is not None for context in plan.test)


def test_a_folder_named_like_a_city_is_not_that_city() -> None:
    assert place_name("datasets/atlanta") == "atlanta/" and place_name("atlanta") == "atlanta"


@pytest.mark.parametrize(
    ("options", "task"),
    [
        ({"protocol": "productivity", "form": "paper"}, "salt_lake_city -> atlanta, all intersections"),
        ({"train": "atlanta", "weather": "published"}, "atlanta -> atlanta"),
        ({"train": "atlanta", "weather": "county"}, "atlanta -> atlanta, county weather"),
        ({"protocol": "systematicity", "horizon_s": 400.0}, "systematicity (grid), 400 s"),
    ],
)
def test_a_task_says_in_what_it_departs_from_the_protocol(options, task: str) -> None:  # type: ignore[no-untyped-def]
    assert make_plan(GeneralizationConfig(scale="paper", test_limit=1, **options).resolved()).task == task


def test_evaluation_seeds_extend_and_every_intersection_has_its_own() -> None:
    one, other = (procedural_context(inflow_vph_per_lane=flow) for flow in (300, 500))
    assert evaluation_seeds(5).of(one)[:3] == evaluation_seeds(3).of(one)
    assert len({*evaluation_seeds(5).of(one), *evaluation_seeds(5).of(other)}) == 10
    assert evaluation_seeds(5).of(one) == evaluation_seeds(5).of(one.replace(adoption=1.0))


def frames(config: GeneralizationConfig) -> int:
    """Return the frames of a training run of PPO."""
    return train_config(config, make_plan(config), parse_entry("ppo"), 0).total_frames


def test_scales_fill_what_is_null() -> None:
    config = GeneralizationConfig(scale="paper").resolved()
    assert (config.seeds, config.episodes, config.test_limit) == (4, 5000, 0)
    assert frames(config) == 5000 * 1950
    assert config.resolved() == config
    given = GeneralizationConfig(scale="small", frames=777, seeds=1).resolved()
    assert (frames(given), given.seeds, given.eval_seeds) == (777, 1, SCALES["small"].eval_seeds)


def test_training_episodes_may_be_shorter_than_those_of_the_evaluation() -> None:
    config = GeneralizationConfig(scale="small", episodes=3, train_horizon_s=300.0).resolved()
    assert frames(config) == 3 * (600 - 50)
    warm = dataclasses.replace(config, train_warmup_s=100.0)
    assert frames(warm) == 3 * (600 - 200)
    slow = dataclasses.replace(config, train_options=("env.hold_s=2",))
    assert frames(slow) == 3 * 138, "as many episodes, with fewer decisions"
    assert train_config(warm, make_plan(warm), parse_entry("ppo"), 0).env.warmup_s == 100.0
    assert evaluation_env(warm).warmup_s == 25.0
    run = train_config(config, make_plan(config), parse_entry("ppo"), 0)
    assert run.env.horizon_s == 300.0
    assert (evaluation_env(config).horizon_s, evaluation_env(config).drain_s, run.env.drain_s) == (1000.0, 600.0, 0.0)


def test_entries() -> None:
    assert parse_entry("ppo_paper_residual").algo == "ppo_paper"
    assert parse_entry("ppo_paper_residual").action == "residual"
    assert parse_entry("glide").kind == "scripted"
    assert parse_entry("mine:gentle").name == "gentle"
    for name in ("human", "pppo", "ppo_residual_residual"):
        with pytest.raises(IzooError, match=r"choose one of: .*ppo_residual.*glide"):
            parse_entry(name)


def test_a_policy_must_not_be_taken_for_what_stands_beside_it(tmp_path) -> None:  # type: ignore[no-untyped-def]
    shutil.copy(catalog.weights("measured_search"), tmp_path / "uncommanded.pt")
    shutil.copy(catalog.weights("measured_search"), tmp_path / "ppo_untrained.pt")
    for name in (
        str(tmp_path / "uncommanded.pt"),
        "mine:uncommanded",
        "mine:human",
        str(tmp_path / "ppo_untrained.pt"),
    ):
        with pytest.raises(IzooError, match="as what the benchmark puts beside it is; rename it"):
            parse_entry(name)


def test_beside_what_is_trained_stands_what_is_not() -> None:
    def names(*algos: str) -> list[str]:
        return [entry.name for entry in GeneralizationConfig(algos=algos).entries()]

    baselines = ["human", "uncommanded"]
    beside = ["constant_2.0", "cap_0.6", "ppo_untrained", "ddpg_residual_untrained"]
    assert sorted(names("ppo", "ddpg_residual")) == sorted([*baselines, *beside, "ppo", "ddpg_residual"])
    assert names("uncommanded", "ppo", "ppo_untrained").count("uncommanded") == 1
    assert names("glide", "cap_0.8") == [*baselines, "glide", "cap_0.8"]
    entry = parse_entry("ddpg_residual_untrained")
    assert (entry.kind, entry.algo, entry.action) == ("untrained", "ddpg", "residual")


def test_runs_have_the_options_of_the_protocol() -> None:
    config = GeneralizationConfig(
        algos=("ddpg_residual",), train_options=("algo.gamma=0.9",), horizon_s=500.0
    ).resolved()
    run = train_config(config, make_plan(config), config.entries()[-1], 3)
    assert (run.algo.name, run.algo.gamma, run.action.name, run.seed) == ("ddpg", 0.9, "residual", 3)
    assert (run.env.horizon_s, run.evaluation.contexts) == (500.0, 0)
    assert run.validation.every_batches == 0
    chosen = dataclasses.replace(config, select="best")
    validated = train_config(chosen, make_plan(chosen), config.entries()[-1], 3)
    assert validated.validation.every_batches > 0
    assert run.contexts.split == "train" and run.contexts.weather == "published"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"episodes": 3, "frames": 3}, "both"),
        ({"algos": ()}, "one or more"),
        ({"algos": ("ppo", "ppo")}, "once"),
        ({"algos": ("glide", "mine:glide")}, "once"),
        ({"train_options": ("algo.gamma=0.9", "seed=3")}, "by seeds"),
        ({"train_options": ("+contexts.split=all",)}, "by protocol"),
        ({"train_options": ("env.horizon_s=100",)}, "train_horizon_s"),
        ({"eval_seeds": 0}, "eval_seeds"),
        ({"train_options": ("simulator=twin",)}, "by simulator or train_simulator"),
        ({"num_envs": 8}, "set train_workers, or train_simulator=twin"),
        ({"simulator": "twin", "train_simulator": "sumo", "num_envs": 8}, "train_simulator=twin"),
        ({"simulator": "twin", "num_envs": 0}, "num_envs"),
        ({"test": "atlanta"}, "in_distribution"),
        ({"protocol": "systematicity", "train": "atlanta"}, "procedural"),
        ({"protocol": "systematicity", "form": "paper"}, "leave train, test, weather and form out"),
        ({"protocol": "systematicity", "weather": "county"}, "leave train, test, weather and form out"),
        ({"test_set": "sample"}, "is of protocol=systematicity; leave it out"),
    ],
)
def test_bad_options_say_what_to_do(options, message) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(IzooError, match=message):
        GeneralizationConfig(**options)


@pytest.mark.parametrize("plus", ["", "+", "++"])
def test_the_evaluation_has_the_environment_of_the_training_but_for_its_length(plus: str) -> None:
    words = ("env.hold_s=2", "env.warmup_s=100", "env.neighbours=[leader]")
    config = GeneralizationConfig(train_options=tuple(f"{plus}{word}" for word in words)).resolved()
    env = evaluation_env(config)
    assert (env.hold_s, env.neighbours, env.warmup_s) == (2.0, ("leader",), EnvConfig().warmup_s)
    assert evaluation_env(dataclasses.replace(config, train_options=("env.lane_change=true",))).lane_change


def test_a_recipe_is_an_entry_with_its_own_length_and_environment() -> None:
    config = GeneralizationConfig(
        algos=("recipe:busy_lane_search", "ppo"),
        frames=1000,
        train_simulator="twin",
        num_envs=8,
        untrained_seeds=1,
        scale="small",
    ).resolved()
    entries = {entry.name: entry for entry in config.entries()}
    recipe = entries["busy_lane_search"]
    run = train_config(config, make_plan(config), recipe, 2)
    assert (run.algo.name, run.action.name, run.simulator, run.seed) == ("cmaes", "advise", "twin", 2)
    assert run.total_frames == 1_990_000, "a recipe brings its length"
    assert run.contexts.name == "city", "the protocol says where to train"
    assert run.evaluation.contexts == 0
    ppo = train_config(config, make_plan(config), entries["ppo"], 0)
    assert (ppo.simulator, ppo.num_envs, ppo.validation.simulator) == ("twin", 8, "sumo")
    assert evaluation_env(config, recipe) == dataclasses.replace(run.env, emit=(), drain_s=600.0)
    assert evaluation_env(config, recipe).hold_s == 2.0
    assert evaluation_env(config, entries["ppo"]).hold_s is None
    untrained = entries["busy_lane_search_untrained"]
    assert (untrained.kind, untrained.algo, untrained.options) == ("untrained", "cmaes", recipe.options)
    assert [len(config.seeds_of(entries[name])) for name in ("busy_lane_search", "ppo_untrained", "uncommanded")] == [
        4,
        1,
        1,
    ]
    with pytest.raises(IzooError, match="busy_lane_search"):
        parse_entry("recipe:busy_lane_serch")


def test_a_policy_that_ships_is_an_entry_with_its_own_environment() -> None:
    config = GeneralizationConfig(algos=("zoo:measured_search", "uncommanded"), horizon_s=300.0).resolved()
    entries = {entry.name: entry for entry in config.entries()}
    shipped, uncommanded = entries["measured_search"], entries["uncommanded"]
    assert (shipped.name, shipped.kind, shipped.policy) == ("measured_search", "scripted", "zoo:measured_search")
    own, common = evaluation_env(config, shipped), evaluation_env(config, uncommanded)
    assert own.observed == zoo.load("measured_search").env.observed != common.observed
    assert (own.hold_s, own.horizon_s, own.warmup_s) == (2.0, 300.0, common.warmup_s)
    with pytest.raises(IzooError, match="zoo:measured_search"):
        parse_entry("zoo:measured_serch")
