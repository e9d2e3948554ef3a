"""``contexts.drivers`` and ``contexts.fleet``: in every source, part of a context's identity, and read with care."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from izoo import evaluate, train
from izoo.cli.option_command import compose_config
from izoo.conf.context_choices import DatasetContexts, PcgContexts
from izoo.conf.train_options import TrainConfig
from izoo.contexts import catalogue
from izoo.contexts.population import DRIVER_CLASSES, DriverPopulation, read_population
from izoo.contexts.procedural import procedural_context
from izoo.errors import IzooError
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from izoo.options import from_mapping, to_mapping
from izoo.results.store import context_from_dict
from izoo.traffic.drivers import built_in_population
from izoo.traffic.sampling import sample_traffic


def own_population(tau_s: float = 0.6) -> dict[str, Any]:
    """The built-in population, but for the time headway of light drivers."""
    built_in = dataclasses.asdict(built_in_population())
    numbers = zip(DRIVER_CLASSES, built_in["log_mean"], built_in["log_cov"], strict=True)
    classes = {name: {"log_mean": list(mean), "log_cov": [list(row) for row in cov]} for name, mean, cov in numbers}
    classes["light"]["log_mean"][2] = float(np.log(tau_s))
    return {"source": "test", "classes": classes}


@pytest.fixture
def own_file(tmp_path: Path) -> Path:
    path = tmp_path / "population.json"
    path.write_text(json.dumps(own_population()))
    return path


FLEET = (0.5, 0.2, 0.1, 0.2)


def chosen(*words: str) -> Any:
    return compose_config(TrainConfig, list(words)).contexts


CITY, IDS = ["contexts=city", "contexts.city=salt_lake_city"], ["contexts=catalogue", "contexts.ids=[5,100..102]"]


@pytest.mark.parametrize(
    "words", [["contexts=pcg"], ["contexts=pcg_easy"], ["contexts=systematicity_test"], CITY, IDS], ids=" ".join
)
def test_every_source_takes_drivers_and_a_fleet(words: list[str], own_file: Path) -> None:
    own_words = [f"contexts.drivers={own_file}", f"contexts.fleet={list(FLEET)}"]
    own, plain = (chosen(*words, *more).build() for more in (own_words, []))
    one, other = (source.sample(np.random.default_rng(4)) for source in (own, plain))
    assert (one.drivers, one.fleet) == (read_population(own_file), FLEET)
    assert (other.drivers, other.fleet) == (None, None)
    assert one.replace(drivers=None, fleet=None) == other.replace(drivers=None)
    assert len({one.content_hash, other.content_hash, one.replace(fleet=None).content_hash}) == 3
    assert one.context_id is None
    assert hasattr(own, "__len__") == hasattr(plain, "__len__")
    if hasattr(own, "__len__"):
        assert len(own) == len(plain)
        assert [(context.drivers, context.fleet) for context in own[:2]] == [(one.drivers, FLEET)] * 2


@pytest.mark.parametrize("approaches", ["one", "all"])
def test_the_dataset_takes_drivers(published: Path, approaches: str, own_file: Path) -> None:
    contexts = DatasetContexts(path=str(published), approaches=approaches, drivers=str(own_file)).build()
    assert {context.drivers for context in contexts} == {read_population(own_file)}


def test_built_in_drivers_leave_identities_as_they_were() -> None:
    """Hashes as they were before contexts could have drivers of their own."""
    assert catalogue.get(654321).content_hash[:16] == "62da2fbbd42a119d"
    assert procedural_context().content_hash[:16] == "1f124128348fc43e"


def test_drivers_are_drawn_from_the_file(own_file: Path) -> None:
    context = procedural_context(adoption=0.0)
    road = read_road(build_net(context.intersection))
    both = context, context.replace(drivers=read_population(own_file))
    built_in, own = (sample_traffic(each, road, 3, 3000.0) for each in both)
    light = np.isin(built_in.source_type, (21, 31))
    assert 0 < (~light).sum() < light.sum()
    np.testing.assert_array_equal(own.tau_s[~light], built_in.tau_s[~light])
    ratio = 0.6 / np.exp(built_in_population().log_mean[0][2])
    np.testing.assert_allclose(own.tau_s[light], ratio * built_in.tau_s[light])
    np.testing.assert_array_equal(own.min_gap_m, built_in.min_gap_m)


def test_a_context_with_drivers_survives_being_saved(own_file: Path) -> None:
    context = procedural_context().replace(drivers=read_population(own_file))
    saved = context_from_dict(json.loads(json.dumps(dataclasses.asdict(context))))
    assert saved == context
    assert saved.content_hash == context.content_hash


def test_the_path_is_saved_whole(own_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(own_file.parent)
    config = TrainConfig(contexts=PcgContexts(drivers=own_file.name))
    assert from_mapping(TrainConfig, to_mapping(config)).contexts.drivers == str(own_file)


def broken(change: Any) -> str:
    content = own_population()
    change(content)
    return json.dumps(content)


def _set(name: str, key: str, value: Any) -> Any:
    return lambda content: content["classes"][name].update({key: value})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("no JSON", "it holds no drivers"),
        ("[" * 100_000, "it holds no drivers"),
        ("[1, 2]", "it holds no drivers"),
        (broken(lambda c: c["classes"].pop("heavy")), "it holds no drivers .*heavy"),
        (broken(lambda c: c.update(converged=False)), "did not converge; calibrate again"),
        (broken(_set("light", "log_mean", [2.9, 0.8, -1.2, -0.3])), "log_mean, 5 for each of light and heavy"),
        (broken(_set("light", "log_mean", [2.9, "x", -1.2, -0.3, 0.5])), "needs numbers in log_mean"),
        (broken(_set("light", "log_mean", [2.9, 0.8, -1.2, -0.3, float("nan")])), "not finite"),
        (broken(_set("light", "log_mean", [10**400, 0.8, -1.2, -0.3, 0.5])), "needs numbers in log_mean"),
        (broken(_set("light", "log_cov", None)), "needs numbers in log_cov, 5 x 5"),
        (broken(_set("light", "log_cov", [1, 2, 3, 4, 5])), "needs numbers in log_cov, 5 x 5"),
        (broken(_set("heavy", "log_mean", [15.0, 2.0, 1.5, 1.0, 1.5])), r"median v0_mps of heavy drivers is exp\(15\)"),
        (broken(_set("heavy", "log_cov", np.tri(5).tolist())), "heavy drivers is not symmetric"),
        (broken(_set("heavy", "log_cov", np.ones((5, 5)).tolist())), "not positive definite"),
        (broken(_set("light", "log_cov", (9.0 * np.eye(5)).tolist())), "standard deviation above 2"),
    ],
)
def test_a_file_that_cannot_be_used_says_why(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "population.json"
    path.write_text(text)
    with pytest.raises(IzooError, match=message) as caught:
        chosen("contexts=pcg", f"contexts.drivers={path}").build()
    assert str(path) in str(caught.value)


def test_a_file_that_is_not_there_is_named() -> None:
    with pytest.raises(IzooError, match="cannot read the drivers /nowhere: No such file"):
        chosen("contexts=city", "contexts.drivers=/nowhere").build()
    with pytest.raises(IzooError, match="needs numbers in log_mean"):
        DriverPopulation(((0.0,) * 5,), ())


TOY = [
    *("contexts=pcg_easy", "contexts.adoption=1.0", "env.horizon_s=100", "simulator=twin", "num_envs=2", "algo=ppo"),
    *("twin.threads=1", "twin.compare_every=0", "algo.hidden=[8]", "algo.frames_per_batch=100", "total_frames=100"),
    *("algo.minibatch_rows=64", "evaluation.contexts=0", "validation.every_batches=0"),
]


def test_a_run_goes_on_with_the_drivers_that_it_began_with(own_file: Path, tmp_path: Path) -> None:
    """It reads its copy, wherever its folder lies and whatever happens to the file."""
    run_dir, before = tmp_path / "run", own_file.read_text()
    assert train.main([*TOY, f"contexts.drivers={own_file}", f"run_dir={run_dir}"]) == 0
    own_file.unlink()
    moved = run_dir.rename(tmp_path / "moved")
    kept = moved / "drivers-1.json"
    assert kept.read_text() == before
    assert evaluate.COMMAND.compose([f"run={moved}"]).contexts.drivers == str(kept)
    assert evaluate.COMMAND.compose([f"run={moved}", "contexts=pcg_easy"]).contexts.drivers is None
    assert train.main([f"resume={moved}", "total_frames=200"]) == 0
    assert kept.read_text() == before
