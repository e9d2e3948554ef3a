"""Trajectories as a table, one row per vehicle and step, for other emission models and plots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import torch
from tensordict import TensorDictBase

from izoo.emissions.classes import CLASSES
from izoo.envs.mdp.columns import VEHICLE_FLAGS, VEHICLE_FLOATS, VEHICLE_INTS
from izoo.errors import IzooError
from izoo.files import expanded, replacing

FUELS, ELECTRIC = {1: "gasoline", 2: "diesel"}, "electric"


def trajectory_table(rollout: TensorDictBase, step_s: float = 0.5) -> pd.DataFrame:
    """Return the vehicles of a rollout ``[T]`` as a table.

    Args:
        rollout: steps of one environment whose ``config.emit`` holds ``vehicles``, as ``env.rollout`` returns them.
        step_s: seconds from one row of the rollout to the next: ``config.decision_s``.

    Returns:
        One row per vehicle and step, sorted by step: ``step``, ``time_s`` since the end of warm-up, the columns of
        ``("vehicles", ...)`` with their units, and the vehicle's ``model_year``, MOVES ``source_type`` and ``fuel``
        (gasoline, diesel or, of vehicles that are ``electric``, electric).

    Raises:
        IzooError: the rollout holds no vehicles, or more than one environment.
    """
    if ("next", "vehicles", "present") not in rollout.keys(True):
        raise IzooError("the rollout holds no ('vehicles', ...); put 'vehicles' into EnvConfig.emit.")
    if rollout.ndim != 1:
        raise IzooError(f"the rollout has batch size {list(rollout.batch_size)}; index one environment out first.")
    vehicles = rollout["next", "vehicles"]
    present = vehicles["present"]
    step = torch.arange(1, present.shape[0] + 1).unsqueeze(-1).expand_as(present)[present]
    columns = {"step": step.numpy(), "time_s": step.numpy() * step_s}
    for name in (*VEHICLE_INTS, *VEHICLE_FLAGS, *VEHICLE_FLOATS):
        if name != "present":
            columns[name] = vehicles[name][present].numpy()
    table = pd.DataFrame(columns)
    classes = [CLASSES[c] for c in table["moves_class"]]
    table["model_year"] = [year for year, _, _ in classes]
    table["source_type"] = [source for _, source, _ in classes]
    fuels = [FUELS[fuel] for _, _, fuel in classes]
    table["fuel"] = np.where(table["electric"], ELECTRIC, fuels)
    return table


def write_trajectories(rollout: TensorDictBase, path: str | Path, step_s: float = 0.5) -> Path:
    """Write :func:`trajectory_table` as CSV; the file appears whole or not at all.

    Raises:
        IzooError: as :func:`trajectory_table`, or there is no such folder.
    """
    path = expanded(path)
    if not path.parent.is_dir():
        raise IzooError(f"{path.parent} is not a folder; make it first, or write elsewhere.")
    with replacing(path) as partial:
        trajectory_table(rollout, step_s).to_csv(partial, index=False)
    return path
