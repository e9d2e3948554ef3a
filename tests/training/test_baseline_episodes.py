"""Training episodes beside the same ones without the policy."""

import contextlib
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from izoo import train
from izoo.algos.drivers.uncommanded import UncommandedDriver
from izoo.algos.learners.base import ACTION, MASK
from izoo.algos.learners.mappo import TEAM_BASELINE
from izoo.cli.option_command import compose_config
from izoo.conf.train_options import TrainConfig
from izoo.contexts.context import Context
from izoo.contexts.source import RandomSchedule
from izoo.envs import EcoDrivingEnv
from izoo.envs.mdp.frame import TEAM_REWARD
from izoo.envs.mdp.observation import SPEED_SCALE_MPS
from izoo.errors import IzooError
from izoo.training import baseline_episodes, run_folder
from izoo.training.baseline_episodes import BaselineComparison
from izoo.training.collectors import BatchSource
from izoo.training.loggers import MetricsTable
from tests.envs.worlds import defer

WORDS = [
    *("contexts=pcg_easy", "contexts.adoption=1.0", "contexts.inflow_vph_per_lane=500", "env.horizon_s=105"),
    *("env.warmup_s=20", "env.hold_s=2", "env.reward=fuel_team", "simulator=twin", "num_envs=4", "twin.threads=1"),
    *("twin.surrogate=compiled", "twin.compare_every=2", "algo=mappo", "algo.credit=team"),
    *("algo.control_variate=team", "algo.frames_per_batch=48"),
]
"""Episodes of 42.5 decisions."""


class Crawl(UncommandedDriver):
    """Every CV drives at 6 m/s at most."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        super().forward(tensordict)
        tensordict["agents", "defer"] = ~tensordict[MASK]
        speed = tensordict["agents", "observation"][..., :1] * SPEED_SCALE_MPS
        return tensordict.set(ACTION, ((6.0 - speed) / 2.0).clamp(-3.0, 2.6))


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baseline_episodes, "BLOCK", 4)


def config(*words: str) -> TrainConfig:
    return compose_config(TrainConfig, [*WORDS, *words])


def schedule(options: TrainConfig) -> RandomSchedule:
    return RandomSchedule(options.contexts.build(), options.seed)


def collected(options: TrainConfig, driver: UncommandedDriver, batches: int) -> list[TensorDictBase]:
    with contextlib.closing(BatchSource(options, driver, schedule(options))) as source:
        return [source.next().clone() for _ in range(batches)]


def test_uncommanded_training_is_what_it_is_compared_with(tmp_path: Path) -> None:
    """Batch after batch, at whichever phase: the same rewards, and nothing saved."""
    options = config()
    assert options.env.decisions == 43, "the last decision is shorter"
    rows = []
    with contextlib.closing(BaselineComparison(options, schedule(options), tmp_path)) as beside:
        for batch in collected(options, UncommandedDriver(), 8):
            beside.add(batch)
            torch.testing.assert_close(batch["next", TEAM_BASELINE], batch["next", TEAM_REWARD], rtol=0.0, atol=0.0)
            rows.append(beside.compare(batch))
    assert float(batch["next", TEAM_REWARD].std()) > 0.0
    found = [row for row in rows if row]
    assert sum(row["compared_episodes"] for row in found) >= 2
    assert all(row["co2_saved"] == row["delay_change_s"] == 0.0 for row in found)
    assert any(row["co2_saved_over_human"] != 0.0 for row in found), "other vehicles"


def test_a_crawling_policy_is_seen_to_lose(tmp_path: Path) -> None:
    options = config("twin.stagger=false", "env.horizon_s=185")
    with contextlib.closing(BaselineComparison(options, schedule(options), tmp_path)) as beside:
        batches = collected(options, Crawl(), 7)
        for batch in batches:
            beside.add(batch)
        rows = [row for row in map(beside.compare, batches) if row]
    # Vehicles that are still under way at the horizon have burned less by then, so it is the delay that shows.
    assert rows and all(row["delay_change_s"] > 10.0 for row in rows)
    assert all(row["co2_saved"] != 0.0 != row["co2_saved_over_human"] for row in rows)
    less = torch.cat([(b["next", TEAM_REWARD] - b["next", TEAM_BASELINE]).flatten() for b in batches])
    assert float(less.mean()) < 0.0


@pytest.mark.slow
def test_they_are_the_same_numbered_episodes_and_kept(tmp_path: Path) -> None:
    options = dataclasses.replace(config(), env=dataclasses.replace(config().env, emit=("metrics", TEAM_REWARD)))
    order = schedule(options)
    with contextlib.closing(BaselineComparison(options, order, tmp_path)) as beside:
        played = beside._compared["uncommanded"].episodes([2, 10])
        with contextlib.closing(EcoDrivingEnv(order, config=options.env, simulator="twin")) as env:
            context, seed = order(10)
            state, rewards = env.reset(context=context, seed=seed), []
            for _ in range(options.env.decisions):
                state = env.step_lean(defer(state))
                rewards.append(float(state[TEAM_REWARD]))
    team = played[10].series[TEAM_REWARD]
    np.testing.assert_allclose(team, rewards, rtol=1e-4, atol=1e-5)
    assert len(team) == options.env.decisions and played[10].sums.max() > 0.0
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")}
    with contextlib.closing(BaselineComparison(options, order, tmp_path)) as other:
        again = other._compared["uncommanded"].episodes([10])[10]
    assert kept and {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")} == kept, "played once"
    assert np.array_equal(again.sums, played[10].sums) and np.array_equal(again.series[TEAM_REWARD], team)


def test_what_cannot_be_played_is_named(tmp_path: Path) -> None:
    options = config()
    with contextlib.closing(BaselineComparison(options, lambda _: fail("no such net"), tmp_path)) as beside:
        beside.expect([])
        with pytest.raises(IzooError, match="no such net"):
            beside._compared["human"].episodes([4])


def fail(message: str) -> tuple[Context, int]:
    raise IzooError(message)


@pytest.mark.slow
def test_a_run_writes_what_it_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With random phases and advice; training is the same whether episodes are compared or not."""
    monkeypatch.setenv("IZOO_CACHE_DIR", str(tmp_path / "cache"))
    words = [*WORDS, "action=advise", "evaluation.contexts=0", "validation.every_batches=0", "total_frames=480"]
    words += ["algo.value_norm=running", "algo.epochs=1"]
    for name, every in (("compared", 2), ("alone", 0)):
        assert train.main([*words, f"twin.compare_every={every}", f"run_dir={tmp_path / name}"]) == 0
    tables = [MetricsTable.read(tmp_path / name / run_folder.METRICS_FILE) for name in ("compared", "alone")]
    assert len(tables[0].series("co2_saved_over_human")[1]) > 0 and tables[1].series("co2_saved_over_human")[1] == []
    for column in ("reward", "loss_critic", "grad_norm"):
        assert tables[0].series(column) == tables[1].series(column)
