"""Many environments on the twin, in this process: one compiled call for each thread's share of them."""

from __future__ import annotations

import contextlib
import itertools
import weakref
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait

import numpy as np
import torch

from izoo.compiling import compiling_once
from izoo.emissions.moves import MovesSurrogate
from izoo.emissions.weights import load_weights
from izoo.envs.backend import CLOSED, Play, clear_ended
from izoo.envs.config import KEEP_LANE, STEP, EnvConfig
from izoo.envs.mdp.frame import frame_bytes, map_frames, row_of
from izoo.envs.mdp.snapshot import Scene
from izoo.envs.twin.runtime.batch_step import conclude_all, drive_all, play_all, warm_up_all
from izoo.envs.twin.runtime.batched_emissions import GROUP, Emitter
from izoo.envs.twin.runtime.episode_setup import Prepared, TwinRun, prepare
from izoo.envs.twin.runtime.prefetch import ADDRESSES, no_ranges
from izoo.envs.twin.runtime.preparers import Preparers, fixed
from izoo.envs.twin.runtime.scratch import Desk
from izoo.envs.twin.runtime.thread_pool import ThreadPool
from izoo.errors import IzooError, check_choice, check_whole
from izoo.gpu import check_gpu
from izoo.networks.clock import to_ms
from izoo.networks.net.build import build_nets

CORES_FOR_PROCESSES, ENVS_FOR_PROCESSES = 4, 64
"""From so many threads and environments on processes prepare the episodes: each takes a second to begin."""
FEWER_ENVS = 8
"""Environments that are stepped in the time in which the tensors of a step are made."""
SURROGATES = ("torch", "cuda", "compiled")


def check_settings(config: EnvConfig) -> None:
    """Raise :class:`IzooError` where settings ask for what the twin has not."""
    if config.gui:
        raise IzooError("env.gui shows SUMO, and the twin has no window; use simulator=sumo with one environment.")


class TwinBackend:
    """A :class:`~izoo.envs.backend.Backend` of ``N`` environments on the twin.

    Results depend neither on the number of environments nor on that of threads.

    Args:
        config: the environments' settings.
        num_envs: ``N``.
        threads: how many threads share the environments out among them, this one included.
        surrogate: what computes CO2: ``torch``, the module in one call for all vehicles; ``cuda``, the same on a GPU;
            or ``compiled``, as SUMO's environments have it.

    Attributes:
        frames: the arrays ``[N, ...]`` that this backend writes.
        played: called by each thread with its share of the environments, ``slice``, when it has written their frames,
            and again with those whose frames have changed since; ``None``: nobody asks.
    """

    played: Callable[[slice], None] | None = None

    def __init__(self, config: EnvConfig, num_envs: int, threads: int = 1, surrogate: str = "compiled") -> None:
        check_whole("num_envs", num_envs, 1, 65536)
        check_whole("threads", threads, 1, 1024)
        check_choice("surrogate", surrogate, SURROGATES)
        if surrogate == "cuda":
            check_gpu("surrogate", "torch")
        check_settings(config)
        self.config, self.num_envs, self.surrogate = config, num_envs, surrogate
        self.wanted_threads, self.threads = threads, min(threads, num_envs)
        self.frames = map_frames(np.zeros(frame_bytes(config, num_envs), np.uint8), config, num_envs)
        self._runs: list[TwinRun | None] = [None] * num_envs
        self._addresses = np.zeros((num_envs, ADDRESSES), np.int64)
        self._left = np.zeros(num_envs, np.int64)
        self._most_vehicles = 0
        self._step_ms = to_ms(config.step_s)
        self._weights = load_weights()
        module = MovesSurrogate(self._weights).to("cuda" if surrogate == "cuda" else "cpu")
        # Each thread's environments are neighbours: lines of the cache that two of them share belong to one thread.
        # The first thread has fewer, since it makes the tensors meanwhile.
        fewer = min(FEWER_ENVS, num_envs // self.threads // 4) if self.threads > 1 else 0
        ends = [(num_envs + fewer) * (thread + 1) // self.threads - fewer for thread in range(self.threads)]
        bounds = [0, *ends]
        self._shares = [slice(*pair) for pair in itertools.pairwise(bounds)]
        self._emitters = [Emitter(module) for _ in self._shares]
        self._desks = [Desk() for _ in self._shares]
        self._ranges = [no_ranges() for _ in self._shares]
        self._ahead: dict[int, tuple[int, Future[Prepared]]] = {}
        self._expected = np.full(num_envs, -1)
        # Where several threads share the environments out, each does what torch does for its own share, alone.
        self._pool = ThreadPool(self.threads, _use_one_torch_thread)
        # One core steps, and those that it leaves idle in between do not suffice for many.
        several = self.threads >= CORES_FOR_PROCESSES and num_envs >= ENVS_FOR_PROCESSES
        self._preparers = Preparers(config, self.threads - 1 if several else 0)
        self._finalizer = weakref.finalize(self, _close, self._pool, self._preparers)

    @property
    def started(self) -> bool:
        """Whether every environment has begun an episode."""
        return not self.closed and None not in self._runs

    @property
    def closed(self) -> bool:
        """Whether all simulations were ended for good."""
        return not self._finalizer.alive

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
        self._ahead[index] = number, self._preparers.submit(play)
        self._expected[index] = number

    def unexpected(self, numbers: np.ndarray) -> list[int]:
        """Return the environments whose next episode, by its number ``[N]``, is not the one that is prepared ahead."""
        return np.flatnonzero(self._expected != numbers).tolist()

    def forget_ahead(self) -> None:
        """Forget the episodes that are prepared ahead or are to be: they are prepared when their turn comes."""
        waiting = [future for _, future in self._ahead.values() if not future.cancel()]
        self._ahead.clear()
        self._expected[:] = -1
        wait(waiting)

    def begin(self, plays: Mapping[int, Play]) -> None:
        """Begin episodes in some environments, and write their first frames."""
        if self.closed:
            raise IzooError(CLOSED)
        self._prepare_now(plays)
        self._compile()
        for index, play in plays.items():
            self._runs[index] = None
            desk = self._desks[bisect_right(self._shares, index, key=lambda share: share.start) - 1]
            prepared = self._take(index, play, desk)
            run = TwinRun(self.config, row_of(self.frames, index), self._weights, prepared, desk)
            self._runs[index] = run
            self._most_vehicles = max(self._most_vehicles, len(prepared.traffic))
            self._addresses[index], self._left[index] = run.addresses, self.config.total_steps

    def _compile(self) -> None:
        """Compile what steps call, by stepping no environment; other processes wait meanwhile."""
        none, emitter, ranges = slice(0, 0), self._emitters[0], self._ranges[0]
        with compiling_once(play_all if self.surrogate == "compiled" else drive_all):
            if self.surrogate == "compiled":
                self._drive_share(none, self._left[none], False, emitter, ranges)
            else:
                drive_all(self._addresses[none], self._step_ms, self.config.lane_change, emitter.by_class, ranges)
                conclude_all(self._addresses[none], ranges)
            warm_up_all(self._addresses[none], 0, self._step_ms, ranges)

    def _prepare_now(self, plays: Mapping[int, Play]) -> None:
        """Let processes prepare what is not ready, where there are some; or else build the nets together."""
        absent = {index: play for index, play in plays.items() if not self._is_ready(index, play.number)}
        if self._preparers.processes and len(absent) >= ENVS_FOR_PROCESSES:
            for index, play in absent.items():
                self.expect(index, play.number, fixed(play))
            return
        with contextlib.suppress(IzooError):  # raised again where that episode is prepared
            build_nets([play.context.intersection for play in absent.values()])

    def _is_ready(self, index: int, number: int) -> bool:
        known, future = self._ahead.get(index, (-1, None))
        return future is not None and known == number and future.done()

    def pack(self) -> list[np.ndarray]:
        """Return the state of every environment as compressed bytes, uint8."""
        with ThreadPoolExecutor(self.threads) as pool:
            return list(pool.map(TwinRun.pack, (self._run(index) for index in range(self.num_envs))))

    def unpack(self, plays: Mapping[int, Play], packed: Sequence[np.ndarray]) -> None:
        """Go on from the states of all environments, which play ``plays``."""
        with self._whole():
            self.begin(plays)
            for index, state in enumerate(packed):
                run = self._run(index)
                run.unpack(state)
                self._left[index] = 0 if run.episode.over else self.config.total_steps - run.episode.steps

    def plays(self) -> list[Play]:
        """Return what every environment plays."""
        return [self._run(index).play for index in range(self.num_envs)]

    def _take(self, index: int, play: Play, desk: Desk) -> Prepared:
        """Return an episode ready to be played: the one that was prepared ahead, if it is that."""
        number, future = self._ahead.pop(index, (-1, None))
        self._expected[index] = -1
        if future is not None and not future.cancel() and number == play.number:
            prepared = future.result()
            if prepared.play == play:
                return prepared
        return prepare(self.config, play, desk)

    def step(self, meanwhile: Callable[[], None] | None = None) -> Sequence[int]:
        """Simulate one decision of every environment whose episode has not ended.

        Raises:
            IzooError: the environments are closed, no episode has begun, or there is none to go on with.
        """
        self._run(0)
        ended = clear_ended(self.config, self.frames)
        with self._whole():
            until_due = self.config.decide != STEP
            self._play(np.minimum(self._until_horizon_or_end(), self.config.hold_steps), meanwhile, until_due)
            for index in np.flatnonzero((self._left <= self.config.drain_steps) & ~ended).tolist():
                run = self._run(index)
                run.end_step()
                if run.episode.over:
                    self._left[index] = 0
                self._taken(slice(index, index + 1))
        return ()

    def _until_horizon_or_end(self) -> np.ndarray:
        """Return how many steps each environment has until its horizon, or its end where that is past, ``[N]``."""
        drain = self.config.drain_steps
        return np.where(self._left > drain, self._left - drain, self._left)

    def advance(self, decisions: Sequence[int]) -> None:
        """Play on in each environment for so many decisions, with every CV left to its driver.

        Args:
            decisions: ``[N]``; so few that no episode comes to its horizon.

        Raises:
            IzooError: an episode would come to its horizon, or decisions last until somebody is to decide.
        """
        if self.config.decide != STEP:
            raise IzooError(
                f"advance() counts decisions of one length, and with env.decide={self.config.decide} each lasts until "
                "a CV is to decide; set env.decide=step."
            )
        try:
            given = np.asarray(decisions)
        except ValueError:  # lists of other lengths
            given = np.empty(0)
        whole = given.shape == (self.num_envs,) and given.dtype.kind in "iu"
        steps = given.astype(np.int64) * self.config.hold_steps if whole else given
        if not whole or (steps < 0).any() or (steps >= self._until_horizon_or_end()).any():
            shown = repr(decisions)
            raise IzooError(
                f"advance({shown if len(shown) < 80 else shown[:80] + '...'}): give each of {self.num_envs} "
                "environments a whole number of decisions, 0 or more and fewer than its episode has left."
            )
        self.frames["action"][:] = 0.0
        self.frames["lane_change"][:] = KEEP_LANE
        try:
            self.frames["defer"][:] = 1
            with self._whole():
                self._play(steps)
        finally:
            self.frames["defer"][:] = 0

    @contextlib.contextmanager
    def _whole(self) -> Iterator[None]:
        """End all episodes if interrupted: driving and sums would no longer belong to the same step."""
        try:
            yield
        except BaseException:
            self._runs[:] = [None] * self.num_envs
            raise

    def _play(self, steps: np.ndarray, meanwhile: Callable[[], None] | None = None, until_due: bool = False) -> None:
        """Simulate ``steps`` ``[N]`` in each environment, which are shared out among the threads.

        With ``until_due``, so many at most: each plays on until one of its CVs is to decide.
        """
        self._pool.work(lambda thread: self._play_share(thread, steps, until_due), meanwhile)
        self._left -= steps

    def _play_share(self, thread: int, steps: np.ndarray, until_due: bool) -> None:
        """Simulate a thread's share of the environments, whose working memory is on its desk."""
        share = self._shares[thread]
        self._drive_share(share, steps[share], until_due, self._emitters[thread], self._ranges[thread])
        self._taken(share)

    def _taken(self, rows: slice) -> None:
        if self.played is not None:
            self.played(rows)

    def share_out(self, task: Callable[[slice], object]) -> None:
        """Call ``task`` with each thread's share of the environments, all threads side by side."""
        self._pool.work(lambda thread: task(self._shares[thread]))

    def _drive_share(
        self, share: slice, steps: np.ndarray, until_due: bool, emitter: Emitter, ranges: np.ndarray
    ) -> None:
        addresses = self._addresses[share]
        if self.surrogate == "compiled":
            rows = emitter.rows(GROUP * self._most_vehicles)
            play_all(addresses, steps, until_due, self._step_ms, self.config.lane_change, rows, ranges)
            return
        step = 0
        while (steps > step).any():
            # From here on, those that have been played are left out.
            chosen = addresses if steps.min() > step else addresses[steps > step]
            drive_all(chosen, self._step_ms, self.config.lane_change, emitter.by_class, ranges)
            emitter.emit(chosen)
            conclude_all(chosen, ranges)
            step += 1
            if until_due:
                for k in np.flatnonzero(steps > step).tolist():
                    if self._run(share.start + k).episode.between_decisions:
                        steps[k] = step

    def _run(self, index: int) -> TwinRun:
        run = self._runs[index]
        if self.closed:
            raise IzooError(CLOSED)
        if run is None:
            raise IzooError("no episode has begun; call reset() first.")
        return run

    def scene(self, index: int = 0) -> Scene:
        """Return the present state of an environment."""
        check_whole("index", index, 0, self.num_envs - 1)
        return self._run(index).episode.scene()

    def close(self) -> None:
        """End all simulations."""
        self._finalizer()
        self._ahead.clear()
        self._runs[:] = [None] * self.num_envs


def _use_one_torch_thread() -> None:
    """Begin a thread of the pool: torch keeps the number of threads of each thread of Python by itself."""
    torch.set_num_threads(1)


def _close(pool: ThreadPool, preparers: Preparers) -> None:
    preparers.close()
    pool.close()
