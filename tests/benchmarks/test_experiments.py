"""Experiments: what the files that ship list is there to be trained and played, and what a file gets wrong is said."""

import os
from pathlib import Path

import pytest
import torch
import yaml

from izoo import zoo
from izoo.algos.learners.registry import make_algorithm
from izoo.benchmarks.campaign.__main__ import CampaignConfig
from izoo.benchmarks.campaign.experiment import read_experiment, shipped
from izoo.benchmarks.campaign.jobs import PartRun, reads_folder, untrained
from izoo.conf.train_options import TrainConfig
from izoo.errors import IzooError
from izoo.metrics.summary import TRAINING


def parts(name: str) -> list[str]:
    return list(read_experiment(name).parts)


def made(name: str, part: str, folder: Path) -> PartRun:
    """A part of an experiment that ships; one of measured intersections needs them."""
    experiment, dataset = read_experiment(name), None
    if reads_folder(experiment.parts[part].task):
        if "IZOO_TEST_DATA" not in os.environ:
            pytest.skip("IZOO_TEST_DATA is unset; it names the folder with the published dataset's sample")
        dataset = f"{os.environ['IZOO_TEST_DATA']}/salt-lake-city-60"
    return PartRun(experiment, part, folder, CampaignConfig(dataset=dataset))


@pytest.mark.parametrize(("name", "part"), [(name, part) for name in shipped() for part in parts(name)])
def test_everything_that_ships_can_be_trained_and_played(name: str, part: str, tmp_path: Path) -> None:
    """Options compose, environments are of one length, and contexts of the training are none of the test."""
    run = made(name, part, tmp_path)
    assert all(config.evaluation.contexts == 0 for config in run.runs.wanted.values())
    environments = [run.env(entry) for entry in run.entries]
    assert {(env.horizon_s, env.drain_s) for env in environments} == {(run.task.env.horizon_s, 600.0)}
    played = {task: {context.content_hash for context in contexts} for task, contexts in run.tests.items()}
    assert not played[run.task.name] & played.get(run.task.name + TRAINING, set())
    jobs = run.jobs()
    assert [str(job) for job in jobs[:1]] == [f"test uncommanded, seed 0, {run.part.simulators[0]}"]
    assert len(jobs) == len(set(jobs)) and run.missing() == jobs


def test_the_ablation_has_every_combination(tmp_path: Path) -> None:
    run = made("ablation", "ablation", tmp_path)
    grid, wanted = run.part.grid, run.runs.wanted
    names = {f"{a}-{b}-{c}" for a in grid["scope"] for b in grid["baseline"] for c in grid["reward"]}
    assert len(names) == 24 and {name for name, _ in wanted} == names
    team = wanted["every_8_s-none-team", 3]
    assert (team.seed, team.env.decide, team.env.hold_s, team.env.reward.eta) == (3, "step", 8.0, 1.0)
    own = wanted["per_vehicle-paired-own", 0]
    assert (own.env.decide, own.algo.control_variate, own.env.reward.eta) == ("vehicle", "vehicle", 0.0)
    every = own.validation.every_batches * own.algo.frames_per_batch
    assert own.total_frames >= 5 * every, "enough validations for a curve"


def test_each_training_seed_plays_episodes_of_its_own_and_a_driver_all_of_them(tmp_path: Path) -> None:
    run = made("reference", "salt_lake_city", tmp_path)
    seeds = {
        (job.entry, job.seed, job.simulator): {play.seed for play in run._plays(job)[run.task.name][:1]}
        for job in run.jobs()
        if job.kind == "test"
    }
    of_ppo = [seeds["ppo", k, "twin"] for k in range(4)]
    assert len(set.union(*of_ppo)) == 4
    context = run.tests[run.task.name][0]
    glide = next(job for job in run.jobs() if job.entry == "glide" and job.simulator == "twin")
    plays = [play.seed for play in run._plays(glide)[run.task.name] if play.context is context]
    assert set(plays) == set.union(*of_ppo), "so that everything pairs up"
    assert ("ppo", 0, "sumo") in seeds and ("ppo", 1, "sumo") not in seeds, "SUMO plays one training seed"


def test_a_part_tests_what_another_one_trained_under_other_conditions(tmp_path: Path) -> None:
    run = made("reference", "adoption_1", tmp_path)
    assert run.trainer.name == "measured" and run.task.name == "measured, adoption=1"
    assert {context.adoption for context in run.tests[run.task.name]} == {1.0}
    assert not any(job.kind == "train" for job in run.jobs())
    assert run.configs["mappo", 1] == run.trainer.configs["mappo", 1]
    after = made("reference", "busy_lane", tmp_path).configs["mappo_after_imitation", 2]
    assert after.start == str(tmp_path / "busy_lane" / "train" / "imitation" / "seed2") and after.algo.name == "mappo"


def test_entries_keep_their_own_environments(tmp_path: Path) -> None:
    run = made("reference", "busy_lane", tmp_path)
    shipped_ = run.env("measured_search")
    assert shipped_.observed == zoo.load("measured_search").env.observed != run.env("ppo").observed
    assert (run.env("ppo").action, run.env("glide").action) == ("speed", "acceleration")
    assert run.env("planner").hold_s == 4.0


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"parts": {"a": {"task": "busy_lan"}}}, "Did you mean 'busy_lane'"),
        ({"parts": {"a": {"task": "busy_lane", "entries": ["glide"]}}}, r"unknown parts\.a\.entries 'glide'"),
        ({"parts": {"a": {"task": "busy_lane", "trained_in": "b"}}}, r"unknown parts\.a\.trained_in 'b'"),
        ({"parts": {"a": {"tsak": "busy_lane"}}}, r"parts\.a\.task"),
        ({"parts": {"a": {"task": "busy_lane", "simulators": ["smuo"]}}}, "Did you mean 'sumo'"),
        ({"entries": {"x": {"like": "y"}}, "parts": {}}, r"unknown entries\.x\.like 'y'"),
        ({}, "cannot be read"),
    ],
)
def test_what_a_file_gets_wrong_is_one_sentence(content: dict, message: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(IzooError, match=message):
        PartRun(read_experiment(str(path)), "a", tmp_path, CampaignConfig())
    with pytest.raises(IzooError, match=r"Did you mean 'reference'\?.* Or name a YAML file"):
        read_experiment("refrence")


def test_an_untrained_entry_is_what_the_run_of_that_seed_begins_with() -> None:
    config = TrainConfig(seed=3)
    torch.manual_seed(3)
    begun = make_algorithm(config.algo, config.action, config.env).policy.state_dict()
    torch.manual_seed(0)
    entry, other = (untrained(c).state_dict() for c in (config, TrainConfig()))
    weights = [name for name in begun if hasattr(begun[name], "dim") and begun[name].dim() == 2]
    assert weights and all(torch.equal(begun[name], entry[name]) for name in weights)
    assert not all(torch.equal(begun[name], other[name]) for name in weights)
