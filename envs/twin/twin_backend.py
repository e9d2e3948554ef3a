"""Many environments on the twin, in this process: one compiled call for each thread's share of them."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import numpy as np
import torch

from izoo.compiling import compiling_once
from izoo.emissions.moves import MovesSurrogate
from izoo.emissions.weights import load_weights
from izoo.envs.backend import Play
from izoo.envs.config import KEEP_LANE, EnvConfig
from izoo.envs.mdp.frame import frame_bytes, map_frames, row_of
from izoo.envs.mdp.scene import Scene
from izoo.envs.twin.crowd import conclude_all, drive_all, emit_and_conclude_all, gather_all, scatter_all
from izoo.envs.twin.twin_run import Prepared, TwinRun, prepare
from izoo.envs.twin.whole_net import to_ms
from izoo.errors import IzooError, check_choice, check_range

SURROGATES = ("torch", "compiled")


class TwinBackend:
    """A :class:`~izoo.envs.backend.Backend` of ``N`` environments on the twin.

    Results depend neither on the number of environments nor on that of threads.

    Args:
        config: the environments' settings.
        num_envs: ``N``.
        threads: how many threads share the environments out among them, this one included.
        surrogate: what computes CO2: ``torch``, the module in one call for all vehicles, or ``compiled``.

    Attributes:
        frames: the arrays ``[N, ...]`` that this backend writes.
    """

    def __init__(self, config: EnvConfig, num_envs: int, threads: int = 1, surrogate: str = "torch") -> None:
        check_range("num_envs", num_envs, 1, 65536)
        check_range("threads", threads, 1, 1024)
        check_choice("surrogate", surrogate, SURROGATES)
        if config.gui:
            raise IzooError("env.gui shows SUMO, and the twin has no window; use simulator=sumo with one environment.")
        self.config, self.num_envs, self.surrogate = config, num_envs, surrogate
        self.wanted_threads, self.threads = threads, min(threads, num_envs)
        self.frames = map_frames(bytearray(frame_bytes(config, num_envs)), config, num_envs)
        self._runs: list[TwinRun | None] = [None] * num_envs
        self._addresses = np.zeros((num_envs, 5), np.int64)
        self._changed, self._left = np.zeros(num_envs, np.int64), np.zeros(num_envs, np.int64)
        self._step_ms = to_ms(config.step_s)
        self._weights = load_weights()
        self._module = MovesSurrogate(self._weights)
        self._closed = False
        self._room = 0
        self._ahead: dict[int, tuple[int, Future[Prepared]]] = {}
        self._pool = ThreadPoolExecutor(max(self.threads - 1, 1), "izoo-twin")
        self._preparer = ThreadPoolExecutor(1, "izoo-prepare")
        self._finalizer = weakref.finalize(self, _close, self._pool, self._preparer)

    @property
    def started(self) -> bool:
        """Whether every environment has begun an episode."""
        return self._finalizer.alive and None not in self._runs

    def expect(self, index: int, number: int, play: Callable[[], Play]) -> None:
        """Prepare an environment's next episode ahead of its turn, beside the simulation.

        Args:
            index: the environment.
            number: of the episode in the schedule.
            play: returns the episode; called in another thread.
        """
        known = self._ahead.get(index)
        if known is not None and known[0] == number:
            return
        if known is not None:
            known[1].cancel()
        self._ahead[index] = number, self._preparer.submit(lambda: prepare(self.config, play()))

    def await_prepared(self) -> None:
        """Wait until the episodes that are prepared ahead are ready."""
        wait([future for _, future in self._ahead.values()])

    def begin(self, plays: Mapping[int, Play]) -> None:
        """Begin episodes in some environments, and write their first frames."""
        if not self._finalizer.alive:
            raise IzooError("this environment is closed; make another one.")
        with compiling_once(drive_all):
            for index, play in plays.items():
                self._runs[index] = None
                run = TwinRun(self.config, row_of(self.frames, index), self._weights, self._take(index, play))
                self._runs[index] = run
                self._addresses[index], self._left[index] = run.addresses, self.config.control_steps

    def pack(self) -> list[np.ndarray]:
        """Return the state of every environment as compressed bytes, uint8."""
        return list(self._pool.map(TwinRun.pack, (self._run(index) for index in range(self.num_envs))))

    def unpack(self, plays: Mapping[int, Play], packed: Sequence[np.ndarray]) -> None:
        """Go on from the states of all environments, which play ``plays``."""
        self.begin(plays)
        for index, state in enumerate(packed):
            run = self._run(index)
            run.unpack(state)
            self._left[index] = self.config.control_steps - run.episode.steps

    def numbers(self) -> list[int]:
        """Return the number of every environment's episode in the schedule."""
        return [self._run(index).play.number for index in range(self.num_envs)]

    def _take(self, index: int, play: Play) -> Prepared:
        """Return an episode ready to be played: the one that was prepared ahead, if it is that."""
        number, future = self._ahead.pop(index, (-1, None))
        if future is not None and not future.cancel() and number == play.number:
            prepared = future.result()
            if prepared.play == play:
                return prepared
        return prepare(self.config, play)

    def step(self, meanwhile: Callable[[], None] | None = None) -> Sequence[int]:
        """Simulate one decision of every environment."""
        if self.frames["done"].any():
            ended = int(np.flatnonzero(self.frames["done"])[0])
            steps = self._run(ended).episode.steps
            raise IzooError(f"the episode ended after {steps} steps; call reset() before the next step.")
        self._step(None, meanwhile)
        for _ in range(1, self.config.hold_steps):
            # An episode that ends within a decision ends it.
            self._step(self._left > 0)
        for index in np.flatnonzero(self._left == 0).tolist():
            self._run(index).finish()
        return ()

    def advance(self, decisions: Sequence[int]) -> None:
        """Play on in each environment for so many decisions, with every CV left to its driver.

        Args:
            decisions: ``[N]``; so few that no episode ends.

        Raises:
            IzooError: an episode would end.
        """
        steps = np.asarray(decisions, np.int64) * self.config.hold_steps
        if steps.shape != (self.num_envs,) or (steps < 0).any() or (steps >= self._left).any():
            raise IzooError(
                f"advance({list(decisions)[:8]}...): give each of {self.num_envs} environments 0 or more decisions, "
                "and fewer than its episode has left."
            )
        self.frames["action"][:] = 0.0
        self.frames["defer"][:] = 1
        self.frames["lane_change"][:] = KEEP_LANE
        for step in range(int(steps.max())):
            self._step(steps > step)
        self.frames["defer"][:] = 0

    def _step(self, chosen: np.ndarray | None, meanwhile: Callable[[], None] | None = None) -> None:
        """Simulate one step of the environments ``chosen`` ``[N]`` bool; ``None``: of all."""
        like = self._run(0).episode.world
        addresses = self._addresses if chosen is None else self._addresses[chosen]
        lane_change = self.config.lane_change
        self._share_out(
            lambda first, every: drive_all(addresses, first, every, self._step_ms, lane_change, like, self._changed),
            meanwhile,
        )
        if self.surrogate == "torch":
            self._emit(addresses, like)
            self._share_out(lambda first, every: conclude_all(addresses, first, every, like))
        else:
            self._share_out(lambda first, every: emit_and_conclude_all(addresses, first, every, like))
        self._left[slice(None) if chosen is None else chosen] -= 1

    def _share_out(self, work: Callable[[int, int], None], meanwhile: Callable[[], None] | None = None) -> None:
        """Do ``work(first, every)`` for all environments, in all threads."""
        every = self.threads
        others = [self._pool.submit(work, first, every) for first in range(1, every)]
        if meanwhile is not None and others:
            meanwhile()
        work(0, every)
        for other in others:
            other.result()

    def _emit(self, addresses: np.ndarray, like: Any) -> None:
        """Compute the CO2 of all vehicles that emit something else than in the step before, in one call."""
        count = int(self._changed[: len(addresses)].sum())
        if count > self._room:
            self._room = 2 * count
            self._motion = np.zeros((3, self._room), np.float32)
            self._weather = np.zeros((2, self._room), np.float32)
            self._classes = np.zeros(self._room, np.int64)
        if count == 0:
            return
        gather_all(addresses, like, self._motion, self._weather, self._classes)
        with torch.inference_mode():
            motion, weather = torch.from_numpy(self._motion[:, :count]), torch.from_numpy(self._weather[:, :count])
            rates = self._module(*motion, torch.from_numpy(self._classes[:count]), *weather)
        scatter_all(addresses, like, rates.numpy())

    def _run(self, index: int) -> TwinRun:
        run = self._runs[index]
        if run is None:
            raise IzooError("no episode has begun; call reset() first.")
        return run

    def scene(self, index: int = 0) -> Scene:
        """Return the present state of an environment."""
        return self._run(index).episode.scene()

    def close(self) -> None:
        """End all simulations."""
        self._finalizer()
        self._ahead.clear()
        self._runs[:] = [None] * self.num_envs


def _close(pool: ThreadPoolExecutor, preparer: ThreadPoolExecutor) -> None:
    preparer.shutdown(cancel_futures=True)
    pool.shutdown()
