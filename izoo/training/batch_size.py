"""How many environments and steps a batch consists of."""

from __future__ import annotations

from izoo.conf.train_options import TWIN_ENVS, TrainConfig
from izoo.envs import simulator_of


def num_envs(config: TrainConfig) -> int:
    """Return how many environments a batch comes from."""
    if simulator_of(config.simulator).batched:
        return TWIN_ENVS if config.num_envs is None else config.num_envs
    return 1 if config.collector.name == "single" else config.num_workers


def frames_per_batch(config: TrainConfig) -> int:
    """Return the steps of a batch over all environments: ``algo.frames_per_batch``, as a multiple of their number.

    Where policies are compared, it is an episode of each.
    """
    count = num_envs(config)
    if config.algo.candidates > 1:
        return count * config.env.decisions
    return -(-config.algo.frames_per_batch // count) * count
