"""Episodes over the machines of a Ray cluster: what :mod:`izoo.results.process_executor` does, elsewhere."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

import cloudpickle

from izoo.errors import IzooError
from izoo.results import ray_cluster as cluster
from izoo.results.playing import EpisodeFailed, Measured, Play, Player, Setup
from izoo.results.process_executor import ATTEMPTS, answer


class RemotePlayer:
    """A player in a process of the cluster."""

    def __init__(self, setup: bytes) -> None:
        import torch

        torch.set_num_threads(1)
        self._player = Player(cloudpickle.loads(setup))

    def play(self, play: bytes) -> tuple[str, Any]:
        """Return :func:`izoo.results.process_executor.answer`."""
        return answer(self._player, play)


class OnRay:
    """Plays episodes in processes of a Ray cluster, each on a core; they wait for one where too few are free."""

    size: int | None = None

    def __init__(self, setup: Setup) -> None:
        if setup.workers < 1:
            raise IzooError(f"num_workers is {setup.workers}; executor=ray needs one or more.")
        self.setup = setup
        self._ray: Any = None
        self._players: list[Any] = []

    def play(self, plays: Sequence[Play], ahead: Sequence[Play] = ()) -> Iterator[tuple[Play, Measured]]:
        """Play episodes and yield them as they finish.

        Raises:
            IzooError: Ray is missing, or an episode's input cannot be used.
            EpisodeFailed: an episode failed otherwise, or lost its process too often.
        """
        ray = self._ray = cluster.connect()
        make = ray.remote(**cluster.WORKER_RESOURCES)(RemotePlayer).remote
        setup = ray.put(cloudpickle.dumps(self.setup))
        self._players = [make(setup) for _ in range(min(self.setup.workers, len(plays)))]
        queue, idle = deque((play, 1) for play in plays), list(self._players)
        running: dict[Any, tuple[Any, Play, int]] = {}
        while queue or running:
            while queue and idle:
                player, (play, attempt) = idle.pop(), queue.popleft()
                running[player.play.remote(cloudpickle.dumps(play))] = (player, play, attempt)
            (done,), _ = ray.wait(list(running), num_returns=1)
            player, play, attempt = running.pop(done)
            try:
                kind, content = ray.get(done)
            except ray.exceptions.RayActorError as error:
                if attempt >= ATTEMPTS:
                    raise EpisodeFailed(f"{play}: the worker process was lost {ATTEMPTS} times.") from error
                self._players.remove(player)
                self._players.append(make(setup))
                idle.append(self._players[-1])
                queue.appendleft((play, attempt + 1))
                continue
            if kind != "played":
                raise (IzooError if kind == "refused" else EpisodeFailed)(f"{play}: {content}")
            idle.append(player)
            yield play, content

    def close(self) -> None:
        """End the processes."""
        for player in self._players:
            self._ray.kill(player)
        self._players.clear()
