"""What training logs of the episodes that ended: one that a lost worker took along is not among them."""

import pytest
import torch

from izoo.contexts.procedural import procedural_context
from izoo.envs import EnvConfig
from izoo.training.batch_statistics import episode_stats, unused_slots
from izoo.training.environments import training_class


def test_a_lost_episode_is_not_logged() -> None:
    config = EnvConfig(emit=(), horizon_s=60.0, warmup_s=5.0)
    env = training_class("sumo")(2, contexts=procedural_context(inflow_vph_per_lane=600.0), config=config)
    try:
        state, steps = env.reset(), []
        for step in range(config.control_steps):
            if step == 50:
                env.backend._workers[1].process.kill()  # type: ignore[union-attr]
            state["agents", "action"] = torch.zeros(2, config.num_agents, 1)
            done, state = env.step_and_maybe_reset(state)
            steps.append(done)
    finally:
        env.close()
    batch = torch.stack(steps, 1)
    assert int(batch["next", "done"].sum()) == 2
    assert episode_stats(batch)["episodes"] == 1.0


@pytest.mark.parametrize(("most", "slots", "enough"), [(2, 64, 4), (5, 64, 16), (16, 64, 32), (17, 64, 0), (0, 64, 0)])
def test_a_size_is_suggested_where_most_slots_stay_empty(most: int, slots: int, enough: int) -> None:
    words = unused_slots([0.0, most], slots)
    assert (f"env.num_agents={enough} " in words) == bool(enough) and bool(words) == bool(enough)
