"""Sweeps over the reward's weights: their points, their front, and one on the real simulator."""

from __future__ import annotations

from pathlib import Path

import pytest

from izoo.benchmarks import tradeoffs
from izoo.benchmarks.campaign.generalization_options import Entry
from izoo.benchmarks.campaign.task_plan import make_plan, train_config
from izoo.benchmarks.tradeoffs import TradeoffsConfig, on_front
from izoo.cli.compose import compose_config
from izoo.cli.help_page import attribute_docs
from izoo.errors import IzooError
from izoo.results import read_table
from izoo.training.run_folder import read_config


def test_yaml_equals_dataclass() -> None:
    assert compose_config(TradeoffsConfig, []) == TradeoffsConfig()


def test_every_combination_of_weights_is_a_point() -> None:
    config = TradeoffsConfig(
        learner="ppo_residual", eta=(0.0, 1.0), beta=(-3.0,), comfort=(0.5, 2.0), floors_mps=(3.0,)
    )
    entries = {entry.name: entry for entry in config.entries()}
    trained = [name for name, entry in entries.items() if entry.kind == "trained"]
    assert trained == [f"ppo_residual_eta{eta}_beta-3_comfort{c}" for eta in "01" for c in ("0.5", "2")]
    assert entries["glide_floor3"].floor_mps == 3.0 and "uncommanded" in entries
    resolved = config.resolved()
    run = train_config(resolved, make_plan(resolved), entries[trained[1]], 0)
    assert (run.env.reward.eta, run.env.reward.beta, run.env.reward.comfort) == (0.0, -3.0, 2.0)
    assert (run.algo.name, run.action.name) == ("ppo", "residual")


def test_without_weights_the_default_is_the_only_point() -> None:
    config = TradeoffsConfig(beta=(), floors_mps=(), algos=("glide",))
    assert config.entries()[2:] == [
        Entry("glide", "scripted", policy="glide"),
        Entry("ppo", "trained", algo="ppo", action="direct"),
    ]


@pytest.mark.parametrize(
    ("options", "message"),
    [({"learner": "glide"}, "not trained"), ({"eta": (2.0,)}, "eta is 2.0"), ({"learner": "pppo"}, "ppo")],
)
def test_bad_options_say_what_to_do(options, message) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(IzooError, match=message):
        TradeoffsConfig(**options)


def test_help_explains_inherited_options() -> None:
    docs = attribute_docs(TradeoffsConfig)
    assert "glide" in docs["floors_mps"] and "Pareto" not in docs["horizon_s"] and docs["horizon_s"]
    assert docs["seeds"] == "training seeds per point."


def test_the_front_is_what_no_other_point_beats() -> None:
    costs = {"a": (1.0, 5.0), "b": (2.0, 2.0), "c": (2.0, 3.0), "d": (5.0, 1.0), "like b": (2.0, 2.0)}
    assert on_front(costs) == ["a", "b", "d", "like b"]


@pytest.mark.slow
def test_a_sweep_leaves_rows_and_a_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["protocol=systematicity", "frames=150", "horizon_s=100", "test_limit=1", "num_workers=0", "beta=[-1,-9]"]
    words += ["floors_mps=[2,8]", 'train_options=["algo.frames_per_batch=150","algo.epochs=1"]', "simulator=twin"]
    words += ["num_envs=1", f"out={tmp_path / 'out'}", f"cache={tmp_path / 'cache'}"]
    assert tradeoffs.main(words) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "; on the Pareto front of CO2 and delay: " in said and said.endswith(".")
    points = {"human", "uncommanded", "glide_floor2", "glide_floor8", "ppo_beta-1", "ppo_beta-9"}
    assert set(read_table(tmp_path / "out")["policy"]) == points
    assert (tmp_path / "out" / "tradeoffs.png").read_bytes()[:4] == b"\x89PNG"
    for beta in (-1.0, -9.0):
        assert read_config(tmp_path / f"out/train/ppo_beta{beta:g}/seed0").env.reward.beta == beta
    before = (tmp_path / "out" / "rows.csv").read_bytes()
    assert tradeoffs.main(words) == 0
    # Points of a weight that was not swept over have other names: what is there would be lost.
    assert tradeoffs.main([*words, "eta=[0,1]"]) == 2
    assert (tmp_path / "out" / "rows.csv").read_bytes() == before


def test_options_do_not_clash_with_the_choices_of_other_commands() -> None:
    config = compose_config(TradeoffsConfig, ["learner=ddpg", "eta=[0,0.5,1]", "beta=[]"])
    assert list(config.weights()) == ["ddpg_eta0", "ddpg_eta0.5", "ddpg_eta1"]
