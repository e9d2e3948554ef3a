"""Replays: the evaluated episode again, in small numbers that read back to where the vehicles were."""

from __future__ import annotations

import gzip
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from izoo.envs.env import EcoDrivingEnv
from izoo.envs.sumo.simulator import SumoSimulator
from izoo.envs.twin.twin_backend import TwinBackend
from izoo.errors import IzooError
from izoo.evaluation import evaluate_policy
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from izoo.reporting.material import collect
from izoo.reporting.recording import Recorder, geometry, second_differences
from izoo.reporting.replay import Player, scenes
from izoo.reporting.scored import score
from tests.evaluation.conftest import SHORT
from tests.reporting.made_results import rename_policy


def positions(vehicle: list) -> np.ndarray:
    """Path positions of a recorded vehicle in m, as the page's script computes them."""
    return np.cumsum(np.cumsum(vehicle[6])) / 10.0


def test_second_differences_read_back() -> None:
    values = [-1405, -1343, -1280, -1218, 40, 39]
    assert np.cumsum(np.cumsum(second_differences(values))).tolist() == values
    assert second_differences([]) == []


def test_a_recording_says_where_vehicles_were(contexts) -> None:
    env, recorder, seen = EcoDrivingEnv(config=SHORT), Recorder(), []
    try:
        state = env.reset(context=contexts[0], seed=1)
        for _ in range(180):
            scene = env.scene()
            recorder.take(scene)
            numbers = scene.vehicles["vehicle_number"].tolist()
            where = zip(*(scene.vehicles[name] for name in ("path_position_m", "region_lane", "is_cv")), strict=True)
            seen.append(dict(zip(numbers, where, strict=True)))
            state = env.rand_action(state)
            state = env.step(state)["next"]
    finally:
        env.close()
    content = recorder.content()
    assert content["frames"] == 180
    numbers = sorted({number for frame in seen for number in frame})
    assert len(content["vehicles"]) == len(numbers) > 3
    for number, vehicle in zip(numbers, content["vehicles"], strict=True):
        path = positions(vehicle)
        lanes = [lane for lane, count, _ in vehicle[5] for _ in range(count)]
        assert len(lanes) == len(path)
        for k, (position, lane) in enumerate(zip(path, lanes, strict=True)):
            true = seen[vehicle[0] + k][number]
            assert position == pytest.approx(true[0], abs=0.051)
            assert (lane, bool(vehicle[1])) == (true[1], true[2])
    assert content["signals"][0][0] == 0
    assert set(content["signals"][0][1]) <= set("gyr")


def test_geometry_is_centred_on_the_stop_lines(contexts) -> None:
    road = read_road(build_net(contexts[0].intersection))
    drawn = geometry(road)
    ends = np.array([drawn["lanes"][lane]["p"][-2:] for lane, _, _ in drawn["stops"]])
    assert np.abs(ends.mean(axis=0)).max() < 0.02
    assert {approach for _, approach, _ in drawn["stops"]} == set(range(len(road.approaches)))
    assert len(drawn["lanes"]) == len(road.lane_ids)


def test_a_replay_is_the_evaluated_episode(evaluation: Path) -> None:
    (entry, _) = collect(evaluation).entries
    best, worst = scenes(score(entry))
    assert best.benefit >= worst.benefit
    assert best.seed in {1, 2}
    with Player() as player:
        content = json.loads(gzip.decompress(player.replay(best)))
    assert [content[side]["name"] for side in ("baseline", "policy")] == ["human", "glide"]
    assert content["baseline"]["as_evaluated"]
    assert content["policy"]["as_evaluated"]
    assert not any(vehicle[1] for vehicle in content["baseline"]["vehicles"])
    assert any(vehicle[1] for vehicle in content["policy"]["vehicles"])
    assert list((evaluation / "replays").glob("*.json.gz"))


def test_an_episode_is_replayed_on_the_simulator_that_played_it(contexts, evaluation: Path, tmp_path: Path) -> None:
    """Also where one player plays episodes of both, whose settings are the same."""
    folder = tmp_path / "twin"
    evaluate_policy("glide", contexts, [1], SHORT, 0, folder, False, cache=tmp_path / "cache", simulator="twin")
    other = shutil.copytree(evaluation, tmp_path / "sumo", ignore=shutil.ignore_patterns("replays"))
    with Player() as player:
        for path, backend in ((folder, TwinBackend), (other, SumoSimulator)):
            (entry, _) = collect(path).entries
            content = json.loads(gzip.decompress(player.replay(scenes(score(entry))[0])))
            assert content["baseline"]["as_evaluated"] and content["policy"]["as_evaluated"]
            assert player._env is not None and isinstance(player._env.backend, backend)


def test_what_has_changed_is_not_replayed(evaluation: Path, tmp_path: Path) -> None:
    folder = rename_policy(evaluation, tmp_path / "results", "glide", "other")
    (entry, _) = collect(folder).entries
    with Player() as player, pytest.raises(IzooError, match="was a Python object"):
        player.replay(scenes(score(entry))[0])


def test_a_replay_that_differs_says_so(evaluation: Path, tmp_path: Path) -> None:
    folder = rename_policy(evaluation, tmp_path / "results", "glide", "glide", factor=1.001)
    for path in (folder / "replays").glob("*"):
        path.unlink()
    (entry, _) = collect(folder).entries
    with Player() as player:
        content = json.loads(gzip.decompress(player.replay(scenes(score(entry))[0])))
    assert not content["policy"]["as_evaluated"]
    assert content["baseline"]["as_evaluated"]
