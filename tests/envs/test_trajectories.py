"""Trajectory export: the same numbers as the rollout, one row per vehicle and step."""

import contextlib
from pathlib import Path

import pandas as pd
import pytest
import torch

from izoo.contexts.procedural import procedural_context
from izoo.emissions.moves import MovesSurrogate
from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.envs.views.trajectories import trajectory_table, write_trajectories
from izoo.errors import IzooError

CONFIG = {"horizon_s": 120.0, "warmup_s": 5.0}


def test_the_table_holds_every_vehicle_with_class_and_emission(tmp_path: Path) -> None:
    context = procedural_context(inflow_vph_per_lane=600.0, grade=0.03)
    with contextlib.closing(EcoDrivingEnv(context, config=EnvConfig(**CONFIG))) as env:
        rollout = env.rollout(1000, auto_reset=True)
    table = pd.read_csv(write_trajectories(rollout, tmp_path / "trajectories.csv"))
    assert len(table) == int(rollout["next", "vehicles", "present"].sum()) > 100
    assert list(tmp_path.iterdir()) == [tmp_path / "trajectories.csv"]
    assert set(table["fuel"]) <= {"gasoline", "diesel"}
    assert table["model_year"].between(2009, 2019).all()
    column = {name: torch.tensor(table[name].to_numpy()) for name in ("speed_mps", "accel_mps2", "grade_pct")}
    rate = MovesSurrogate()(*(c.float() for c in column.values()), torch.tensor(table["moves_class"]), 20.0, 46.0)
    assert torch.allclose(0.5 * rate.double(), torch.tensor(table["emission_g"]), rtol=1e-3, atol=1e-4)


def test_electric_vehicles_are_marked(tmp_path: Path) -> None:
    context = procedural_context(inflow_vph_per_lane=600.0).replace(engine="electric", adoption=0.3)
    with contextlib.closing(EcoDrivingEnv(context, config=EnvConfig(**CONFIG), simulator="twin")) as env:
        table = trajectory_table(env.rollout(1000))
    assert (table["fuel"] == "electric").equals(table["is_cv"])
    assert table["is_cv"].nunique() == 2 and (table.loc[table["is_cv"], "emission_g"] == 0.0).all()


def test_vehicles_and_a_folder_are_needed(tmp_path: Path) -> None:
    for emit, path, message in (
        (("vehicles",), tmp_path / "nowhere" / "a.csv", "nowhere is not a folder"),
        ((), tmp_path / "a.csv", r"put 'vehicles' into EnvConfig\.emit"),
    ):
        config = EnvConfig(emit=emit, **CONFIG)
        with (
            contextlib.closing(EcoDrivingEnv(procedural_context(), config=config, simulator="twin")) as env,
            pytest.raises(IzooError, match=message),
        ):
            write_trajectories(env.rollout(3), path)
