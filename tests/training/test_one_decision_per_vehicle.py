"""Every learner learns from one decision per vehicle, and what a vehicle was paid uncommanded is taken from its own."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from izoo import train
from izoo.algos.actions.action_modes import SpeedAction
from izoo.algos.drivers.uncommanded import UncommandedDriver
from izoo.algos.learners.base import MASK, REWARD
from izoo.algos.learners.decisions import Decisions, shaped
from izoo.algos.learners.ppo import PPO, PPOConfig
from izoo.algos.learners.registry import make_algorithm
from izoo.cli.option_command import compose_config
from izoo.conf.train_options import TrainConfig
from izoo.contexts.source import RandomSchedule
from izoo.results.playing import VEHICLE_REWARD, VEHICLE_SPANS
from izoo.training.baseline_episodes import BaselineComparison, RewardToGo
from izoo.training.collectors import BatchSource
from izoo.training.loggers import MetricsTable
from izoo.training.run_folder import METRICS_FILE

SMALL = [
    *("contexts=pcg_easy", "contexts.adoption=0.5", "contexts.inflow_vph_per_lane=500", "env.horizon_s=160"),
    *("env.warmup_s=20", "env.reward=fuel", "simulator=twin", "num_envs=4", "twin.threads=1", "twin.stagger=false"),
    *("twin.surrogate=compiled", "twin.compare_every=0", "env.num_agents=32", "env.num_vehicles=64"),
    *("evaluation.contexts=0", "validation.every_batches=0", "algo.hidden=[16]", "algo.control_variate=vehicle"),
]
ONCE = ["env.decide=vehicle", "env.action=speed", "action=speed", "algo.frames_per_batch=40"]
HELD = ["env.hold_s=2", "algo.frames_per_batch=160"]


def config(*words: str) -> TrainConfig:
    return compose_config(TrainConfig, [*SMALL, *words])


def batches(options: TrainConfig, policy: Any, count: int, folder: Path) -> list[TensorDictBase]:
    """Batches with potentials."""
    schedule = RandomSchedule(options.contexts.build(), options.seed)
    with (
        contextlib.closing(BatchSource(options, policy, schedule)) as source,
        contextlib.closing(BaselineComparison(options, schedule, folder)) as paired,
    ):
        found = []
        for _ in range(count):
            batch = source.next().clone()
            paired.add(batch)
            found.append(batch)
    return found


@pytest.mark.parametrize("gamma", [1.0, 0.9])
def test_what_is_still_paid_is_a_discounted_sum(gamma: float) -> None:
    spans = np.array([[3, 10, 4], [7, 0, 2]], np.float32)  # number, first decision, how many
    rewards = np.array([1.0, -2.0, 4.0, 8.0, 5.0, 6.0], np.float32)
    paid = RewardToGo({VEHICLE_SPANS: spans, VEHICLE_REWARD: rewards}, gamma)

    def expected(number: int, decision: int) -> float:
        row = {3: (10, rewards[:4]), 7: (0, rewards[4:])}.get(number)
        if row is None:
            return 0.0
        return sum(float(r) * gamma ** (row[0] + k - decision) for k, r in enumerate(row[1]) if row[0] + k >= decision)

    asked = [(n, d) for n in (0, 3, 5, 7, 12) for d in (0, 1, 2, 9, 10, 12, 13, 14, 50)]
    found = paid.at(*map(np.array, zip(*asked, strict=True)))
    np.testing.assert_allclose(found, [expected(*pair) for pair in asked], rtol=1e-6)
    nobody = RewardToGo({VEHICLE_SPANS: np.zeros((0, 3), np.float32), VEHICLE_REWARD: np.zeros(0, np.float32)}, gamma)
    assert np.array_equal(nobody.at(np.array([0, 4]), np.array([1, 2])), [0.0, 0.0])


def test_uncommanded_vehicles_are_paid_nothing_more_in_any_step(tmp_path: Path) -> None:
    options = config(*HELD)
    for batch in batches(options, UncommandedDriver(options.env), 4, tmp_path):
        mask, plain = batch[MASK], batch["next"][REWARD]
        rest = shaped(batch, options.algo.gamma)["next"][REWARD]  # type: ignore[attr-defined]
        assert float(plain[mask].std()) > 0.02
        torch.testing.assert_close(rest[mask], torch.zeros_like(rest[mask]), rtol=0.0, atol=2e-4)


@pytest.mark.slow
def test_uncommanded_vehicles_are_paid_next_to_nothing_more_for_a_decision(tmp_path: Path) -> None:
    options = config(*ONCE)
    decisions = Decisions()
    found = [decisions(b) for b in batches(options, UncommandedDriver(options.env), 8, tmp_path)]
    plain = torch.cat([part["next"][REWARD].flatten() for part in found])
    rest = torch.cat([shaped(part, 1.0)["next"][REWARD].flatten() for part in found])
    assert len(rest) > 60
    assert float(rest.std()) < 0.1 * float(plain.std()), "rewards are kept every two seconds"


def gradients(algorithm: PPO, batch: TensorDictBase, advantage: torch.Tensor) -> torch.Tensor:
    """Policy gradients ``[episodes, parameters]`` of decisions whose episodes are told by their order."""
    parameters = [p for p in algorithm.actor.parameters() if p.requires_grad]
    found = []
    for rows, own in zip(batch, advantage, strict=True):
        log_prob = algorithm.actor.get_dist(rows).log_prob(rows["agents", "action"])
        gradient = torch.autograd.grad((log_prob * own).sum(), parameters)
        found.append(torch.cat([part.reshape(-1) for part in gradient]))
    return torch.stack(found)


@pytest.mark.slow
def test_the_gradient_is_the_same_in_the_mean_and_varies_less(tmp_path: Path) -> None:
    """Of whole episodes of one small context: what is taken away moves no mean, and most of the variance goes."""
    options = config(*ONCE, "num_envs=64", "contexts.green_s=24", "contexts.red_s=30", "env.horizon_s=200")
    torch.manual_seed(3)
    algorithm = make_algorithm(PPOConfig(hidden=(4,)), SpeedAction(), options.env)
    options = dataclasses.replace(options, algo=dataclasses.replace(options.algo, frames_per_batch=64 * 120))  # type: ignore[type-var]
    plain, less = [], []
    for batch in batches(options, algorithm.policy, 2, tmp_path):
        ends = batch["next", "done"].squeeze(-1).long().cumsum(1)
        for env in range(len(batch)):
            for episode in range(int(ends[env].max())):
                begin = int((ends[env] < episode).sum()) + (episode > 0)
                end = int((ends[env] <= episode).sum())
                steps = batch[env, begin : end + 1]
                decided = Decisions()(steps)
                if len(decided) == 0:
                    continue
                agents = decided["agents"].flatten(0, 2)
                rows = TensorDict({"agents": agents}, agents.batch_size)
                for kept, of in ((plain, decided), (less, shaped(decided, 1.0))):
                    kept.append(gradients(algorithm, [rows], [of["next"][REWARD].flatten()])[0])  # type: ignore[arg-type, list-item]
    first, second = torch.stack(plain), torch.stack(less)
    assert len(first) > 400
    difference = first - second
    error = difference.std(0) / len(first) ** 0.5
    moving = error > 1e-9
    deviations = (difference.mean(0)[moving] / error[moving]).abs()
    assert float(deviations.max()) < 4.5, "that many parameters, some reach 3"
    assert float(second.var(0)[moving].mean()) < 0.3 * float(first.var(0)[moving].mean())


@pytest.mark.slow
@pytest.mark.parametrize("scope", ["vehicle", "step"])
@pytest.mark.parametrize("algo", ["ppo", "mappo", "gcrl", "ddpg", "td3"])
def test_every_learner_learns_in_both_scopes(algo: str, scope: str, tmp_path: Path) -> None:
    words = [f"algo={algo}", *(ONCE if scope == "vehicle" else HELD), "total_frames=640", f"run_dir={tmp_path / 'run'}"]
    if algo in ("ddpg", "td3"):
        words += ["algo.learning_starts=160"]
    assert train.main([*SMALL, *words]) == 0
    table = MetricsTable.read(tmp_path / "run" / METRICS_FILE)
    _, losses = table.series("loss_actor" if algo in ("ddpg", "td3") else "loss_objective")
    assert len(losses) >= 2 and np.isfinite(losses).all()
    if scope == "vehicle":
        decided = sum(table.series("decisions")[1])
        assert 0 < decided < 1.5 * 640, "a frame of few decisions"


@pytest.mark.slow
def test_learning_on_sumo_sees_the_same_decisions(tmp_path: Path) -> None:
    of_the_twin = ("simulator", "num_envs", "algo.control_variate", "twin.surrogate")
    words = [word for word in SMALL if not word.startswith(of_the_twin)]
    run = tmp_path / "run"
    assert train.main([*words, *ONCE, "num_workers=2", "total_frames=80", f"run_dir={run}"]) == 0
    assert sum(MetricsTable.read(run / METRICS_FILE).series("decisions")[1]) > 20
