"""Training and evaluation on a Ray cluster of two nodes, both on this machine."""

import csv
import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest
import torch

from izoo import evaluate, train
from izoo.algos.learners.registry import make_algorithm
from izoo.errors import IzooError
from izoo.results import ray_cluster as cluster
from izoo.results import read_table
from izoo.training import run_folder
from tests.conftest import Refused

TOY = [
    *("contexts=pcg_easy", "contexts.inflow_vph_per_lane=600", "contexts.lane_length_m=120", "env.horizon_s=75"),
    *("algo.hidden=[16]", "algo.frames_per_batch=200", "algo.minibatch_rows=64", "evaluation.contexts=0"),
    *("checkpoint.every_batches=1", "collector=ray", "num_workers=2"),
]
MEMORY_BYTES = 80 * 2**20
needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="the extra izoo[ray] is not installed")


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Address of a cluster of two nodes with one core each: two workers must use both."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        from ray.cluster_utils import Cluster

        node = {"num_cpus": 1, "object_store_memory": MEMORY_BYTES}
        started = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
        try:
            started.add_node(**node)
            assert len(started.list_all_nodes()) == 2
            yield started.address
        finally:
            started.shutdown()


@pytest.mark.slow
@needs_ray
def test_nobody_without_a_token_reaches_a_cluster_on_this_machine(tmp_path: Path) -> None:
    """Ray listens on all interfaces, and runs what it is sent."""
    stranger = "import sys, ray; ray.init(address=sys.argv[1]); print('inside')"
    program = f"""
import os, subprocess, sys
from izoo.results.ray_cluster import connect
address = connect().get_runtime_context().gcs_address
for mode in ("token", "disabled"):
    told = {{**os.environ, "RAY_AUTH_MODE": mode}}
    done = subprocess.run([sys.executable, "-c", {stranger!r}, address], env=told, capture_output=True, text=True)
    print("inside" if "inside" in done.stdout else "refused")
"""
    told = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    told["HOME"] = str(tmp_path)  # where Ray keeps its token
    done = subprocess.run([sys.executable, "-c", program], env=told, capture_output=True, text=True, timeout=200)
    assert done.stdout.split() == ["inside", "refused"], done.stderr


def run(command: str, words: list[str], address: str) -> None:
    """Run a command of izoo apart, as a driver of the cluster."""
    told, command_line = {**os.environ, "RAY_ADDRESS": address}, [sys.executable, "-m", command, *words]
    done = subprocess.run(command_line, env=told, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@needs_ray
def test_training_and_evaluation_on_two_nodes(address: str, tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    run("izoo.train", [*TOY, "total_frames=400", f"run_dir={run_dir}"], address)
    with (run_dir / run_folder.METRICS_FILE).open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [int(row["frames"]) for row in table] == [200, 400]
    assert int(table[-1]["episodes"]) == 4, "both workers have ended two episodes of 100 steps"
    weights = run_folder.load_algorithm(run_dir)[0].state_dict()["policy"]
    torch.manual_seed(0)
    options = run_folder.read_config(run_dir)
    fresh = make_algorithm(options.algo, options.action, options.env)
    assert any(not torch.equal(weights[key], value) for key, value in fresh.state_dict()["policy"].items())
    words = [f"run={run_dir}", "num_contexts=1", "num_workers=2"]
    run("izoo.evaluate", [*words, "executor=ray", f"out={tmp_path / 'ray'}", f"cache={tmp_path / 'a'}"], address)
    assert evaluate.main([*words, "num_workers=1", f"out={tmp_path / 'here'}", f"cache={tmp_path / 'b'}"]) == 0
    pd.testing.assert_frame_equal(*(read_table(tmp_path / name) for name in ("ray", "here")))


@pytest.mark.slow
@needs_ray
def test_twins_on_two_nodes(address: str) -> None:
    """Each node has one core, so each twin is on another."""
    program = """
from izoo.docs.examples import ray_twins
from izoo.envs import EnvConfig
history = ray_twins.main(nodes=2, num_envs=4, batches=2, steps=20, config=EnvConfig(emit=(), horizon_s=100.0))
assert len(history) == 2 and all(reward == reward and rate > 0.0 for reward, rate in history)
"""
    told = {**os.environ, "RAY_ADDRESS": address}
    done = subprocess.run([sys.executable, "-c", program], env=told, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "batch 2: reward" in done.stdout


def test_a_missing_ray_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, refused: Refused) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(IzooError, match=r"pip install 'izoo\[ray\]'"):
        cluster.connect()
    said = "pip install 'izoo[ray]'"
    refused(evaluate.main, ["policy=glide", "executor=ray", "num_contexts=1", f"out={tmp_path / 'out'}"], said)
    refused(train.main, [*TOY, "total_frames=200", f"run_dir={tmp_path / 'run'}"], said)
    assert not (tmp_path / "run").exists()


@needs_ray
def test_a_cluster_that_is_not_there_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, refused: Refused
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    said = "no Ray cluster at 127.0.0.1:1 (RAY_ADDRESS): Connection refused"
    refused(train.main, [*TOY, f"run_dir={tmp_path / 'run'}"], said)
    assert not (tmp_path / "run").exists()
