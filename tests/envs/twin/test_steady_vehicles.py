"""CO2 on the twin: the surrogate is asked only about vehicles whose inputs are not those of the step before."""

from __future__ import annotations

import contextlib

import numpy as np
import torch

from izoo.contexts.procedural import procedural_context
from izoo.emissions.moves import MovesSurrogate
from izoo.envs import EnvConfig, TwinEnv
from izoo.envs.mdp.columns import ACCEL, EMISSION, GRADE, MOVES_CLASS, SPEED
from tests.envs.worlds import steer

INPUTS = [SPEED, ACCEL, GRADE]


def test_steady_vehicles_keep_their_emission_without_evaluation() -> None:
    """All CO2 is that of the present motion, and many vehicles are steady in a queue at a red light."""
    context = procedural_context(lane_count=2, inflow_vph_per_lane=500.0, adoption=0.3, green_s=20.0, red_s=40.0)
    config = EnvConfig(horizon_s=240.0, warmup_s=60.0, emit=())
    module = MovesSurrogate()
    asked = there = 0
    with contextlib.closing(TwinEnv(3, context, config=config, threads=1)) as env:
        state = env.reset()
        emitter = env.backend._emitters[0]
        before: list[dict[int, tuple[float, ...]]] = [{} for _ in range(3)]
        for step in range(config.control_steps - 1):
            _, state = env.step_and_maybe_reset(steer(state))
            changed = 0
            for index, known in enumerate(before):
                episode = env.backend._run(index).episode
                rows, tables = episode.members, episode.tables
                now = {int(row): tuple(tables.floats[row, INPUTS]) for row in rows}
                changed += sum(known.get(row) != motion for row, motion in now.items())
                there += len(rows)
                known.clear()
                known.update(now)
                speed, accel, grade = torch.from_numpy(tables.floats[rows][:, INPUTS].astype(np.float32)).unbind(-1)
                classes = torch.from_numpy(tables.ints[rows, MOVES_CLASS])
                weather = context.temperature_c, context.humidity_pct
                rates = module(speed, accel, grade, classes, *weather) * config.step_s
                np.testing.assert_allclose(tables.floats[rows, EMISSION], rates.numpy(), rtol=1e-5, atol=1e-6)
            if step > 0:  # the first time, everybody is new to this test
                assert int(emitter.by_class.sum()) == changed
            asked += changed
    assert 0.3 * there < asked < 0.85 * there
