"""Vehicles that SUMO drops because they could not enter the network: counted, and not reported on the terminal."""

import contextlib
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from izoo.envs import EcoDrivingEnv, EnvConfig, SumoParallelEnv
from izoo.envs.sumo.session import sumo_arguments
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from izoo.traffic.sampling import sample_traffic, write_routes
from tests.envs.worlds import cramped, defer, play

CONFIG = EnvConfig(horizon_s=90.0, warmup_s=10.0, emit=("metrics",))
DROPPED = "will not be able to depart"


def test_dropped_vehicles_are_counted(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with contextlib.closing(EcoDrivingEnv(cramped(), config=CONFIG)) as env:
        frames = play(env, CONFIG.control_steps, defer, env.reset(context=cramped(), seed=1))
    assert "Error" not in capfd.readouterr().err
    metrics = {name: value[-1].numpy() for name, value in frames["next", "metrics", "approach"].items()}
    net, routes = build_net(cramped().intersection), tmp_path / "routes.rou.xml"
    write_routes(sample_traffic(cramped(), read_road(net), 1, CONFIG.horizon_s), read_road(net), routes)
    program = Path(os.environ["SUMO_HOME"]) / "bin" / "sumo"
    arguments = [*sumo_arguments(net, routes, 1, CONFIG.step_s), "--end", f"{CONFIG.horizon_s:g}"]
    said = subprocess.run([str(program), *arguments], capture_output=True, text=True, check=True).stderr
    lost = [line for line in said.splitlines() if DROPPED in line]
    ways = [line.split("lane '")[1][0] for line in lost]
    assert len(lost) > 5
    assert metrics["dropped"][:4].tolist() == [ways.count(leg) for leg in "ABCD"]
    parts = [metrics[name] for name in ("dropped", "waiting", "outside", "early", "entered")]
    assert np.array_equal(metrics["due"], np.sum(parts, axis=0))


def test_worker_processes_do_not_print_dropped_vehicles(capfd: pytest.CaptureFixture[str]) -> None:
    with contextlib.closing(SumoParallelEnv(1, cramped(), config=CONFIG)) as env:
        frames = play(env, CONFIG.control_steps, defer)
    assert frames["next", "metrics", "approach", "dropped"][0, -1].sum() > 0
    assert DROPPED not in capfd.readouterr().err
