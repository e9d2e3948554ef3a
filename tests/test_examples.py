"""Every example of the documentation runs, at toy size."""

import ast
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.envs.worlds import crossing, short

FOLDER = Path(__file__).resolve().parent.parent / "izoo" / "docs" / "examples"
TESTED = {
    *("ppo_by_hand", "stock_torchrl", "sb3_ego", "own_contexts", "own_reward", "own_policy", "own_city"),
    *("offline_data", "rllib_ppo", "ray_twins"),  # the last in training/test_ray.py
}


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Networks this small gain nothing from threads, which on a busy machine wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_every_example_is_tested() -> None:
    assert {path.stem for path in FOLDER.glob("*.py")} - {"__init__"} == TESTED


def test_ppo_by_hand() -> None:
    from izoo.docs.examples import ppo_by_hand

    history = ppo_by_hand.main(total_frames=800, frames_per_batch=400, horizon_s=125.0)
    assert len(history) == 2 and all(np.isfinite(history))
    source = (FOLDER / "ppo_by_hand.py").read_text()
    assert len(source.splitlines()) <= 150
    names = {name for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ImportFrom) for name in [node.module]}
    assert not {name for name in names if name and name.startswith(("hydra", "izoo.train", "izoo.conf", "izoo.algos"))}


LOSSES = ["ppo", *(pytest.param(name, marks=pytest.mark.slow) for name in ("mappo", "graph", "ddpg", "td3"))]


@pytest.mark.parametrize("name", LOSSES)
def test_stock_torchrl_trains_with_every_loss(name: str) -> None:
    """From braking at random, which stops everybody, to driving: TorchRL's collector, buffer and optimiser alone."""
    from izoo.docs.examples import stock_torchrl

    history = stock_torchrl.train(name, batches=15, num_envs=8)
    assert len(history) == 15
    assert history[0] < -2.0 and np.mean(history[-3:]) > -1.2, history
    source = (FOLDER / "stock_torchrl.py").read_text()
    nodes = list(ast.walk(ast.parse(source)))
    loop = next(node for node in nodes if isinstance(node, ast.FunctionDef) and node.name == "train")
    assert loop.end_lineno is not None and loop.end_lineno - loop.lineno < 40
    modules = {node.module for node in nodes if isinstance(node, ast.ImportFrom)}
    izoos = {name for name in modules if name and name.startswith("izoo")}
    assert izoos == {"izoo.algos.losses", "izoo.contexts.procedural", "izoo.envs"}


def test_stable_baselines() -> None:
    pytest.importorskip("stable_baselines3")
    from izoo.docs.examples import sb3_ego

    model = sb3_ego.main(total_timesteps=128, steps_per_update=128, horizon_s=125.0)
    assert model.num_timesteps == 128
    observation = np.zeros(model.observation_space.shape or (), np.float32)
    assert model.predict(observation)[0].shape == (1,)


@pytest.mark.slow
def test_rllib() -> None:
    """Its PPO trains on agents that come and go, and each episode ends with the simulation."""
    pytest.importorskip("pettingzoo")
    pytest.importorskip("ray.rllib.algorithms.ppo", reason="needs ray[rllib]", exc_type=ImportError)
    import ray

    from izoo.docs.examples import rllib_ppo

    settings = {"contexts": crossing(), "config": short(), "simulator": "twin", "max_vehicles": 200}
    env = rllib_ppo.EcoDriving(settings)
    observations, _ = env.reset(seed=0)
    known, over, steps = set(env.agents), False, 0
    while not over:
        assert set(observations) >= set(env.agents) and set(env.agents) <= set(env.observation_spaces)
        actions = {agent: np.zeros(1, np.float32) for agent in env.agents}
        observations, _, _, truncated, _ = env.step(actions)
        known, over, steps = known | set(observations), truncated["__all__"], steps + 1
    assert env.par_env.session.over and len(known) > 10 and steps > 50
    env.close()
    try:
        returns = rllib_ppo.main(iterations=2, steps_per_iteration=300, horizon_s=80.0, num_env_runners=0)
    finally:
        ray.shutdown()
    assert len(returns) == 2 and np.isfinite(returns).all()


def test_own_contexts() -> None:
    from izoo.docs.examples import own_contexts

    played = own_contexts.main(horizon_s=40.0)
    assert played.keys() == {"hilly", "rush hour", "harder"}
    assert all(len(set(names)) == 2 for names in played.values())


def test_own_reward() -> None:
    from izoo.docs.examples import own_reward

    batch = own_reward.main(horizon_s=75.0)
    mask, reward = batch["agents", "mask"], batch["next", "agents", "reward"].squeeze(-1)
    terms = batch["next", "agents", "reward_vector"]
    assert mask.any() and not reward[~mask].any()
    speed, emission = (terms[..., own_reward.COLUMN[name]] for name in ("speed_mps", "emission_g"))
    assert (reward <= speed / 15.0 - emission + 1e-5)[mask].all() and (reward[mask] != 0).any()
    summed = batch["next", "agents", "episode_reward"].squeeze(-1)
    torch.testing.assert_close(summed[-1].sum(), reward.sum(), rtol=1e-4, atol=1e-4)


def test_own_policy(tmp_path: Path) -> None:
    from izoo.docs.examples import own_policy

    table = own_policy.main(horizon_s=125.0, seeds=(0,), num_workers=0, cache=tmp_path)
    assert set(table["policy"]) == {"human", "uncommanded", "arrive-on-green"}
    own, uncommanded = (table[table["policy"] == name] for name in ("arrive-on-green", "uncommanded"))
    assert len(own) == 2 and (own["agent_steps"] > own["deferred_steps"]).all()
    assert (uncommanded["agent_steps"] == uncommanded["deferred_steps"]).all()


@pytest.mark.parametrize("extract", [None, "osm/west_oakland.osm"])
def test_own_city(extract: str | None, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    pytest.importorskip("osmium")
    from izoo.docs.examples import own_city

    file = None if extract is None else request.getfixturevalue("data") / extract
    sizes = {"horizon_s": 125.0, "seeds": (0,), "num_workers": 0, "max_approaches": 2}
    table = own_city.main(file, tmp_path / "town", **sizes, cache=tmp_path / "cache")
    assert set(table["policy"]) == {"human", "uncommanded", "glide"} and len(table) == 6
    assert table["crossed"].sum() > 0 and (tmp_path / "town").is_dir()
    if extract is None:
        from izoo.networks.dataset.intersections import load_specs

        assert [len(spec.approach_names) for spec in load_specs(tmp_path / "town")] == [4, 3]


@pytest.mark.slow
def test_offline_data(tmp_path: Path) -> None:
    from izoo.docs.examples import offline_data

    losses, summary = offline_data.main(frames=600, updates=20, horizon_s=75.0, contexts=2, cache=tmp_path)
    assert len(losses) == 20 and np.isfinite(losses).all()
    assert {"clone", "glide"} <= summary["entries"].keys()
