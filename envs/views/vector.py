"""Gymnasium's vector environment of a view, whose simulations run in parallel, one process each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import concatenate, create_empty_array, iterate

from izoo.errors import IzooError

Step = tuple[Any, float, bool, bool, dict[str, Any]]


class ViewVector(SyncVectorEnv):
    """``N`` views, each stepped by a thread that sleeps while its simulation's process works.

    ``AsyncVectorEnv`` does the same with a further process per environment. After the end of an episode, the next step
    of that environment begins the next one, ignoring its action (``AutoresetMode.NEXT_STEP``).

    Args:
        make: makes one environment.
        num_envs: ``N``.
    """

    def __init__(self, make: Callable[[], gym.Env[Any, Any]], num_envs: int) -> None:
        if num_envs < 1:
            raise IzooError(f"num_envs is {num_envs}; one environment or more is needed.")
        super().__init__([make] * num_envs, autoreset_mode=AutoresetMode.NEXT_STEP)
        self._threads = ThreadPoolExecutor(num_envs, thread_name_prefix="izoo-view")
        self._ended = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every environment; an integer seed gives ``seed``, ``seed + 1``, ... to them."""
        count = self.num_envs
        seeds = [seed] * count if seed is None else [seed + k for k in range(count)] if isinstance(seed, int) else seed
        if len(seeds) != count:
            raise IzooError(f"{len(seeds)} seeds were given; there are {count} environments.")

        def begin(index: int) -> Step:
            observation, info = self.envs[index].reset(seed=seeds[index], options=options)
            return observation, 0.0, False, False, info

        observations, *_, infos = self._each(begin)
        return observations, infos

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Simulate a step in every environment."""
        single = list(iterate(self.action_space, actions))
        if len(single) != self.num_envs:
            raise IzooError(f"{len(single)} actions were given; there are {self.num_envs} environments.")

        def advance(index: int) -> Step:
            if not self._ended[index]:
                return self.envs[index].step(single[index])  # type: ignore[return-value]
            observation, info = self.envs[index].reset()
            return observation, 0.0, False, False, info

        return self._each(advance)

    def _each(self, act: Callable[[int], Step]) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Call ``act`` for every environment; wait for all of them, even if one fails."""
        futures = [self._threads.submit(act, index) for index in range(self.num_envs)]
        failures = [failure for failure in [future.exception() for future in futures] if failure is not None]
        if failures:
            raise failures[0]
        results = [future.result() for future in futures]
        observations, rewards, terminated, truncated, single_infos = zip(*results, strict=True)
        infos: dict[str, Any] = {}
        for index, info in enumerate(single_infos):
            infos = self._add_info(infos, info, index)
        empty: Any = create_empty_array(self.single_observation_space, n=self.num_envs, fn=np.zeros)
        batch = concatenate(self.single_observation_space, observations, empty)
        ended = np.array(terminated), np.array(truncated)
        self._ended = ended[0] | ended[1]
        return batch, np.array(rewards, np.float64), *ended, infos

    def close_extras(self, **options: Any) -> None:
        """End all simulations."""
        self._threads.shutdown()
        super().close_extras(**options)
