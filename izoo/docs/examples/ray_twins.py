"""PPO over the nodes of a Ray cluster: each steps a twin of its own with the policy, and this process learns.

``RAY_ADDRESS=HOST:6379 python -m izoo.docs.examples.ray_twins 4`` trains over four nodes; without the variable, Ray
runs on this machine. Every node needs the same izoo.
"""

from __future__ import annotations

import functools
import sys
import time

import torch
from torchrl.envs.utils import ExplorationType

from izoo.algos.actions.action_modes import DirectAction
from izoo.algos.learners.base import MASK, REWARD
from izoo.algos.learners.ppo import PPOConfig
from izoo.algos.learners.registry import make_algorithm
from izoo.contexts.procedural import ProceduralSource
from izoo.envs import EnvConfig, TwinEnv
from izoo.results import ray_cluster


def make_env(node: int, nodes: int, num_envs: int, threads: int, config: EnvConfig) -> TwinEnv:
    """Return the environments of a node; of the episodes, which are numbered, every ``nodes``-th is its own."""
    torch.manual_seed(node)  # of what its policy draws
    contexts = ProceduralSource()
    return TwinEnv(
        num_envs, contexts, config=config, threads=threads, surrogate="compiled", shard=node, num_shards=nodes
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
    ray_cluster.connect()
    from torchrl.collectors.distributed import RayCollector

    config = config or EnvConfig(emit=())
    torch.manual_seed(0)
    algorithm = make_algorithm(PPOConfig(), DirectAction(), config)
    frames = nodes * num_envs * steps
    collector = RayCollector(
        [functools.partial(make_env, node, nodes, num_envs, threads, config) for node in range(nodes)],
        algorithm.policy,
        frames_per_batch=frames,
        total_frames=batches * frames,
        exploration_type=ExplorationType.RANDOM,
        trust_policy=True,
        collector_kwargs={"track_traj_ids": False, "auto_register_policy_transforms": False},
        remote_configs=ray_cluster.collecting(threads),
        sync=True,  # on-policy: all nodes act with the same weights
    )
    collector.update_policy_weights_(algorithm.policy)
    history = []
    try:
        begin = time.perf_counter()
        for number, batch in enumerate(collector):
            algorithm.update(batch.exclude("collector"), number / batches)
            collector.update_policy_weights_(algorithm.policy)
            reward = batch.get(("next", *REWARD)).squeeze(-1)[batch.get(MASK)].mean()
            seconds, begin = time.perf_counter() - begin, time.perf_counter()
            history.append((float(reward), frames / seconds))
            print(f"batch {number + 1}: reward {float(reward):.3f}, {frames / seconds:,.0f} steps/s", flush=True)
    finally:
        collector.shutdown()
    return history


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2)
