"""PPO over the nodes of a Ray cluster: each steps a twin of its own with the policy, and this process learns.

``RAY_ADDRESS=HOST:6379 python -m izoo.docs.examples.ray_twins 4`` trains over four nodes; without the variable, Ray
runs on this machine. Every node needs the same izoo.
"""

from __future__ import annotations

import functools
import sys
import time

import torch

from izoo.algos.actions.action_modes import DirectAction
from izoo.algos.learners.base import ACTION, DONE, LOC, LOG_PROB, MASK, OBSERVATION, REWARD, SCALE, TERMINATED
from izoo.algos.learners.ppo import PPOConfig
from izoo.algos.learners.registry import make_algorithm
from izoo.contexts.procedural import ProceduralSource
from izoo.envs import EnvConfig
from izoo.training.environments import TrainingBatchEnv, training_class
from izoo.training.twin_nodes import TwinNodes

READ = (
    *(OBSERVATION, MASK, ACTION, LOG_PROB, LOC, SCALE),
    *(("next", *key) for key in (OBSERVATION, MASK, REWARD, DONE, TERMINATED)),
)
"""What PPO reads of a batch, which is all that nodes send."""


def make_env(node: int, nodes: int, num_envs: int, threads: int, config: EnvConfig) -> TrainingBatchEnv:
    """Return the environments of a node; of the episodes, which are numbered, every ``nodes``-th is its own."""
    return training_class("twin")(
        num_envs,
        contexts=ProceduralSource(),
        config=config,
        threads=threads,
        surrogate="compiled",
        shard=node,
        num_shards=nodes,
    )


def main(
    nodes: int = 2,
    num_envs: int = 64,
    threads: int = 1,
    batches: int = 20,
    steps: int = 60,
    config: EnvConfig | None = None,
) -> list[tuple[float, float]]:
    """Train; return reward per agent-step and environment steps per second of every batch.

    Args:
        nodes: twins; each goes where ``threads`` cores are free.
        num_envs: environments of each.
        threads: of each twin.
        batches, steps: so many batches of so many decisions of every environment.
        config: of the environments.
    """
    config = config or EnvConfig(emit=())
    torch.manual_seed(0)
    algorithm = make_algorithm(PPOConfig(), DirectAction(), config)
    makers = [functools.partial(make_env, node, nodes, num_envs, threads, config) for node in range(nodes)]
    collector = TwinNodes(makers, algorithm.policy, steps, threads, READ)
    history = []
    try:
        begin = time.perf_counter()
        for number in range(batches):
            batch = collector.next()  # on-policy: all nodes act with the present weights
            algorithm.update(batch, number / batches)
            reward = batch.get(("next", *REWARD)).squeeze(-1)[batch.get(MASK)].mean()
            seconds, begin = time.perf_counter() - begin, time.perf_counter()
            history.append((float(reward), batch.numel() / seconds))
            print(f"batch {number + 1}: reward {history[-1][0]:.3f}, {history[-1][1]:,.0f} steps/s", flush=True)
    finally:
        collector.close()
    return history


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2)
