"""Replays: the evaluated episode again, in small numbers that read back to where the vehicles were."""

import contextlib
import gzip
import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from izoo.envs.env import EcoDrivingEnv
from izoo.envs.twin.backend import TwinBackend
from izoo.errors import IzooError
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from izoo.report.recording import Recorder, geometry
from izoo.report.replay import Player, scenes
from izoo.report.report_data import collect
from izoo.results.rollout import evaluate_policy
from izoo.training import run_folder
from tests.conftest import SHORT


def positions(vehicle: list) -> np.ndarray:
    """Path positions of a recorded vehicle in m, as the page's script computes them."""
    return np.cumsum(np.cumsum(vehicle[6])) / 10.0


def test_a_recording_says_where_vehicles_were(contexts) -> None:
    recorder, seen = Recorder(), []
    with contextlib.closing(EcoDrivingEnv(config=SHORT)) as env:
        state = env.reset(context=contexts[0], seed=1)
        for _ in range(180):
            scene = env.scene()
            recorder.take(scene)
            numbers = scene.vehicles["vehicle_number"].tolist()
            where = zip(*(scene.vehicles[name] for name in ("path_position_m", "region_lane", "is_cv")), strict=True)
            seen.append(dict(zip(numbers, where, strict=True)))
            state = env.step(env.rand_action(state))["next"]
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


def played(folder: Path) -> dict:
    """The best scene of glide in a folder, played again."""
    (evaluation,) = collect(folder).evaluations
    with Player() as player:
        return json.loads(gzip.decompress(player.replay(scenes(evaluation, "glide")[0])))


def test_a_replay_is_the_evaluated_episode(evaluation: Path) -> None:
    best, worst = scenes(collect(evaluation).evaluations[0], "glide")
    assert best.saved >= worst.saved and best.seed in {1, 2}
    content = played(evaluation)
    assert [content[side]["name"] for side in ("baseline", "policy")] == ["uncommanded", "glide"]
    assert content["baseline"]["as_evaluated"] and content["policy"]["as_evaluated"]
    assert any(vehicle[1] for vehicle in content["policy"]["vehicles"])
    assert list((evaluation / "replays").glob("*.json.gz"))


def test_an_episode_is_replayed_on_the_simulator_that_played_it(contexts, tmp_path: Path) -> None:
    folder = tmp_path / "twin"
    evaluate_policy("glide", contexts, [1], SHORT, simulator="twin", workers=1, out=folder, cache=tmp_path / "cache")
    (evaluation,) = collect(folder).evaluations
    with Player() as player:
        content = json.loads(gzip.decompress(player.replay(scenes(evaluation, "glide")[0])))
        assert content["baseline"]["as_evaluated"] and content["policy"]["as_evaluated"]
        assert player._env is not None and isinstance(player._env.backend, TwinBackend)


def changed(evaluation: Path, tmp_path: Path, **changes: object) -> Path:
    """A copy of the evaluation without its replays, and with changes to what it says of glide."""
    folder = Path(shutil.copytree(evaluation, tmp_path / "results", ignore=shutil.ignore_patterns("replays")))
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["policies"]["glide"]["0"] |= changes
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


def test_a_replay_that_differs_says_so(evaluation: Path, tmp_path: Path) -> None:
    folder = changed(evaluation, tmp_path)
    rows = pd.read_csv(folder / "rows.csv")
    rows["crossed"] += rows["policy"] == "glide"
    rows.to_csv(folder / "rows.csv", index=False)
    content = played(folder)
    assert content["baseline"]["as_evaluated"] and not content["policy"]["as_evaluated"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"source": None}, "does not say what the policy glide was made from"),
        ({"source": "os:getcwd"}, "imports=true allows to import it"),
        ({"source": "gone.pt"}, "gone.pt is gone"),
        ({"weights": "f" * 64}, "has changed since it was evaluated"),
    ],
)
def test_what_cannot_be_played_again_is_said(evaluation: Path, tmp_path: Path, changes: dict, message: str) -> None:
    with pytest.raises(IzooError, match=message):
        played(changed(evaluation, tmp_path, **changes))


@pytest.mark.parametrize("source", ["run/checkpoints/step-000000000001.pt", "results/run"])
def test_a_run_whose_algorithm_is_code_is_not_imported(source: str, evaluation: Path, here: Path) -> None:
    """Whether its checkpoint is named, or its folder, seen from the current one."""
    (here / "evil.py").write_text("open('ran', 'w').close()\n")
    folder = changed(evaluation, here, source=source)
    (folder / "run" / "checkpoints").mkdir(parents=True)
    (folder / "run" / "checkpoints" / "step-000000000001.pt").touch()
    (folder / "run" / run_folder.CONFIG_FILE).write_text("algo: {name: 'evil:Thing'}\n")
    with pytest.raises(IzooError, match="of the code evil:Thing; imports=true allows to import it"):
        played(folder)
    assert not (here / "ran").exists()
