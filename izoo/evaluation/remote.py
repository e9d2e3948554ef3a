"""Episodes over the machines of a Ray cluster: what :func:`izoo.evaluation.processes.play_all` does, elsewhere."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from izoo.envs.config import EnvConfig
from izoo.errors import IzooError
from izoo.evaluation import ray_cluster as cluster
from izoo.evaluation.processes import ATTEMPTS, EpisodeFailed, Player, Rows, Task


class RemotePlayer:
    """An environment and the policies in a process of the cluster."""

    def __init__(self, policies: Mapping[str, bytes], config: EnvConfig, simulator: str) -> None:
        import torch

        torch.set_num_threads(1)
        self._player = Player(policies, config, simulator)

    def play(self, task: Task) -> tuple[str, Any]:
        """Return ``("rows", rows)`` of an episode, or ``("refused", why)`` where its input cannot be used."""
        try:
            return "rows", self._player.play(task)
        except IzooError as error:
            return "refused", str(error)


def play_on_ray(
    tasks: Sequence[Task],
    policies: Mapping[str, bytes],
    config: EnvConfig,
    num_workers: int,
    simulator: str = "sumo",
) -> Iterator[tuple[Task, Rows]]:
    """Play episodes on a Ray cluster and yield them as they finish.

    Args:
        tasks, policies, config, simulator: as for :func:`izoo.evaluation.processes.play_all`.
        num_workers: processes, each on a core of the cluster; they wait for one where too few are free.

    Raises:
        IzooError: Ray is missing, or an episode's input cannot be used.
        EpisodeFailed: an episode failed otherwise, or lost its process too often.
    """
    if not tasks:
        return
    if num_workers < 1:
        raise IzooError(f"num_workers is {num_workers}; executor=ray needs one or more.")
    ray = cluster.connect()
    make = ray.remote(**cluster.WORKER_RESOURCES)(RemotePlayer).remote
    shared = ray.put(dict(policies))
    queue = deque((task, 1) for task in tasks)
    players = [make(shared, config, simulator) for _ in range(min(num_workers, len(tasks)))]
    running: dict[Any, tuple[Any, Task, int]] = {}
    try:
        idle = list(players)
        while queue or running:
            while queue and idle:
                player, (task, attempt) = idle.pop(), queue.popleft()
                running[player.play.remote(task)] = (player, task, attempt)
            (done,), _ = ray.wait(list(running), num_returns=1)
            player, task, attempt = running.pop(done)
            try:
                kind, content = ray.get(done)
            except ray.exceptions.RayActorError as error:
                if attempt >= ATTEMPTS:
                    raise EpisodeFailed(f"{task}: the worker process died {ATTEMPTS} times.") from error
                players.remove(player)
                players.append(make(shared, config, simulator))
                idle.append(players[-1])
                queue.appendleft((task, attempt + 1))
                continue
            except ray.exceptions.RayTaskError as error:
                raise EpisodeFailed(f"{task}: {error}") from error
            if kind == "refused":
                raise IzooError(f"{task}: {content}")
            idle.append(player)
            yield task, content
    finally:
        for player in players:
            ray.kill(player)
