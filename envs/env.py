"""TorchRL's face of the environments, and one intersection on whichever simulator."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from izoo.contexts.context import Context
from izoo.contexts.procedural import ProceduralSource
from izoo.contexts.source import ContextSource, Schedule, as_schedule, reseed
from izoo.cores import one_torch_thread
from izoo.envs import simulator_of, specs
from izoo.envs.backend import CLOSED, Backend, Play
from izoo.envs.config import MAX_WORKERS, EnvConfig, checked_config
from izoo.envs.frame_io import FrameReader, set_entry
from izoo.envs.mdp.frame import TEAM_REWARD, observation_names, row_of
from izoo.envs.mdp.snapshot import Scene
from izoo.envs.render import draw
from izoo.errors import IzooError, check_seed, check_whole, plain_number
from izoo.networks.road import RoadNet

_log = logging.getLogger("izoo")

Contexts = Context | Sequence[Context] | ContextSource | Schedule
Requested = int | Sequence[int] | torch.Tensor
"""Numbers of episodes that are asked for: one per environment."""


class EcoDrivingBase(EnvBase):
    """An environment over a :class:`~izoo.envs.backend.Backend`: specs, the schedule of episodes, TensorDicts.

    Environment ``k`` plays the episodes ``first + k``, ``first + k + stride``, ... of the schedule, so any number of
    environments play the same episodes.

    Args:
        contexts: what is played: a context, a sequence or a source to draw from, or a schedule; the default draws from
            the procedural training ranges of the systematicity protocol.
        config: settings of the environment.
        seed: base seed; with an episode's number it determines the episode's context and seed.
        batch_size: ``[]`` or ``[N]``.
        backend: simulates ``N`` environments (1 for ``[]``).
        first, stride: numbers of the episodes.
    """

    batch_locked = True
    leaves: tuple[str, ...] = ()
    """Arrays of a frame that are emitted at the root, besides the groups of ``config.emit``."""
    taken_by_backend = False
    """Whether the threads that wrote the frames of a step have taken them, too."""

    def __init__(
        self,
        contexts: Contexts | None,
        config: EnvConfig,
        seed: int,
        batch_size: list[int],
        backend: Backend,
        first: int = 0,
        stride: int = 1,
    ) -> None:
        super().__init__(device=None, batch_size=torch.Size(batch_size))
        self.is_closed = False  # TorchRL closes only what says that it is open
        self.config, self.frames, self.backend = config, backend.frames, backend
        self.schedule = as_schedule(ProceduralSource() if contexts is None else contexts, check_seed(seed))
        self._first, self._stride = first, stride
        self._restart_episodes()
        leaves = [*self.leaves, *(name for name in (TEAM_REWARD,) if name in config.emit)]
        self.reader = FrameReader(config, self.frames, self.batch_size, leaves)
        self.observation_names = observation_names(config)
        self.group_map = {"agents": [f"agent_{k}" for k in range(config.num_agents)]}
        self.observation_spec = specs.observation_spec(config, self.batch_size)
        self.action_spec = specs.action_spec(config, self.batch_size)
        self.reward_spec = specs.reward_spec(config, self.batch_size)
        self.done_spec = specs.done_spec(config, self.batch_size)
        self._in_use = threading.Lock()

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.schedule = reseed(self.schedule, check_seed(seed))
            self._restart_episodes()

    def _restart_episodes(self) -> None:
        """Number episodes from the first again."""
        self._next_episode = self._first + np.arange(self.batch_size.numel())

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, episode: Requested | None = None, **options: Any
    ) -> TensorDictBase:
        if options:
            raise IzooError(
                f"reset() of this environment does not take {', '.join(options)}; give contexts= to the constructor, "
                "or episode= to play given episodes of the schedule."
            )
        mask = None if tensordict is None else self._chosen(tensordict)
        requested = self._requested(episode)
        count = self.batch_size.numel()
        chosen = range(count) if mask is None else torch.nonzero(mask.view(-1)).view(-1).tolist()
        with self.used_by_one_thread():
            numbers = {index: self._take_number(index) if requested is None else requested[index] for index in chosen}
            self.backend.begin({index: Play(*self.schedule(number), number) for index, number in numbers.items()})
            return self._frame()

    def _chosen(self, tensordict: TensorDictBase) -> torch.Tensor | None:
        """Return which environments are to be reset, as far as it is said.

        Raises:
            IzooError: it is said of some of an environment's agents alone.
        """
        whole, agents = tensordict.get("_reset", None), tensordict.get(("agents", "_reset"), None)
        if whole is not None or agents is None:
            return whole
        rows = agents.reshape(self.batch_size.numel(), -1)
        if (rows.any(-1) != rows.all(-1)).any():
            raise IzooError(
                "('agents', '_reset') chooses some agents of an environment, and episodes begin for all of them; give "
                "'_reset' with a flag for each environment."
            )
        return rows.all(-1)

    def _requested(self, episode: Requested | None) -> list[int] | None:
        """Return the number of the episode that is asked for, of each environment."""
        if episode is None:
            return None
        numbers = torch.as_tensor(episode)
        count = self.batch_size.numel()
        whole = not numbers.is_floating_point() and not numbers.is_complex() and numbers.dtype != torch.bool
        if numbers.numel() != count or not whole or (numbers < 0).any():
            what = "a whole number" if count == 1 else f"{count} whole numbers, one per environment,"
            raise IzooError(
                f"reset(episode={plain_number(episode)!r}): give {what} from 0 on; episodes are numbered so."
            )
        return [int(number) for number in numbers.view(-1)]

    def _take_number(self, index: int) -> int:
        """Return the number of the next episode of an environment."""
        number = int(self._next_episode[index])
        self._next_episode[index] += self._stride
        return number

    @contextlib.contextmanager
    def used_by_one_thread(self) -> Iterator[None]:
        """Refuse a second thread: it would take the answers that the first one waits for, and neither would return."""
        if not self._in_use.acquire(blocking=False):
            raise IzooError("another thread steps or resets this environment; give each thread one of its own.")
        try:
            with one_torch_thread():
                yield
        finally:
            self._in_use.release()

    def _truncate(self, index: int) -> None:
        """Report a lost step: the state before it, truncated, without reward; nothing was measured (0 steps)."""
        row = row_of(self.frames, index)
        row["agent_truncated"][:] = row["mask"]
        row["agent_done"][:] = row["mask"]
        row["agent_terminated"][:] = 0
        row["reward"][:] = 0.0
        row["reward_vector"][:] = 0.0
        row[TEAM_REWARD][:] = 0.0
        row["totals"][:] = 0.0
        row["terminated"][:] = 0
        row["truncated"][:] = 1
        row["done"][:] = 1

    def _simulate(self, tensordict: TensorDictBase) -> None:
        """Take the actions and simulate one step."""
        self.require_started()
        with self.used_by_one_thread():
            self.reader.write_action(tensordict)
            self.reader.begin(stepping=True)
            for index in self.backend.step(self.reader.prepare):
                self._truncate(index)
            if not self.taken_by_backend:
                self._take_all()

    def _take_all(self) -> None:
        """Take the frames of all environments."""
        self.share_out(self.reader.take)

    def share_out(self, task: Callable[[slice], object]) -> None:
        """Call ``task`` with the environments, or with each thread's share of them, all threads side by side."""
        task(slice(0, self.batch_size.numel()))

    def require_started(self, call: str = "step") -> None:
        """Raise :class:`IzooError` unless the episodes are running: the environment is closed, or not yet reset.

        Args:
            call: the call that came too early.
        """
        self.require_open()
        if not self.backend.started:
            raise IzooError(f"{call}() came before reset(); call reset() first, it starts the episodes.")

    def require_open(self) -> None:
        """Raise :class:`IzooError` where the environment was closed for good."""
        if self.backend.closed:
            raise IzooError(CLOSED)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._simulate(tensordict)
        return self.reader.read()[0]

    def _frame(self) -> TensorDict:
        self.reader.begin()
        self._take_all()
        return self.reader.read()[1]

    def step_lean(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Step, and return what is set under ``"next"``: ``step`` without its checks."""
        following = self._step(tensordict)
        set_entry(tensordict, "next", following)
        return following

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Step, and begin new episodes where one has ended; return the step and the state to act on next.

        The same as TorchRL's own, but lean (:meth:`step_lean`).
        """
        self._simulate(tensordict)
        following, state = self.reader.read()
        set_entry(tensordict, "next", following)
        begun = self._begin_where_ended()
        return tensordict, state if begun is None else begun

    def scene(self, index: int = 0) -> Scene:
        """Return the present state of an environment, on the twin and in this process whether or not it is emitted.

        Raises:
            IzooError: no episode has begun, or there is no such environment.
        """
        self.require_open()
        check_whole("index", index, 0, max(self.batch_size.numel(), 1) - 1)
        return self.backend.scene(index)

    @property
    def road(self) -> RoadNet:
        """The road net of the present episode, of the first environment."""
        return self.scene().road

    def render(self, *_: Any, index: int = 0, span_m: float = 120.0, size_px: int = 640, **__: Any) -> np.ndarray:
        """Return a top view ``[size_px, size_px, 3]`` uint8 of an environment's present state; no screen is needed.

        TorchRL's ``VideoRecorder`` gets its pictures from here through ``PixelRenderTransform``.
        """
        self.require_started("render")
        return draw(self.scene(index), span_m=span_m, size_px=size_px)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """End all simulations."""
        self.backend.close()
        if not self.is_closed:
            super().close(raise_if_closed=raise_if_closed)

    def _begin_where_ended(self) -> TensorDictBase | None:
        """Begin new episodes where one has ended; return the state to act on if there was any."""
        done = self.frames["done"]
        if b"\1" not in done.tobytes():
            return None
        ended = torch.from_numpy(done.astype(bool)).view(*self.batch_size, 1)
        # Not reset(): given the mask alone, it would blank the rows that go on.
        return self._reset(TensorDict._new_unsafe({"_reset": ended}, batch_size=self.batch_size))


def numbering(number: int | None, of: int, count: int, seed: int, *, name: str = "shard") -> tuple[int, int]:
    """Return the number of the first episode, and the stride, of ``count`` environments that share with others.

    Args:
        number: which of ``of`` groups of ``count`` environments this is; ``None`` where it is the only one.
        seed: for the warning where there may be others.
        name: what the option is called that says ``number``.

    Raises:
        IzooError: there is no such group, or it is not said which this is.
    """
    check_whole(f"num_{name}s", of, 1, MAX_WORKERS)
    if number is not None:
        check_whole(name, number, 0, of - 1)
    elif of > 1:
        raise IzooError(f"num_{name}s is {of}, and it is not said which of them this is; give {name}=k, too.")
    elif multiprocessing.parent_process() is not None:
        # TorchRL's ParallelEnv, say, makes others beside it. No warning of Python: TorchRL silences those in its
        # workers.
        _log.warning(
            "an environment was made in a worker process without %s=: every such process with seed=%s plays the same "
            "episodes. Give %s=k and num_%ss=N, or %s=0 if that is meant.",
            *(name, seed, name, name, name),
        )
    return (number or 0) * count, of * count


class EcoDrivingEnv(EcoDrivingBase):
    """One intersection, in this process, on SUMO (of which a process can hold only one) or on the twin.

    SUMO starts at the first reset.

    Worker ``k`` of ``N`` plays the episodes ``k``, ``k + N``, ... of the schedule; in TorchRL's ``ParallelEnv``, give
    each its ``worker=k`` and ``num_workers=N``, or all play the same. ``reset(episode=3)`` plays a given
    episode; ``reset(context=..., seed=...)`` plays any context.

    Emits (``A`` agent slots, ``V`` vehicle slots; masks say which slots hold something):

    - ``("agents", "observation")`` ``[A, F]`` (names in :attr:`observation_names`), ``("agents", "mask")`` ``[A]``,
      ``("agents", "vehicle")`` ``[A]``, ``("agents", "reward")`` ``[A, 1]``, and per-agent and root done, terminated
      and truncated.
    - with the groups of ``config.emit``: ``("vehicles", ...)`` ``[V]``, ``("signal", ...)``, ``("context", ...)``
      ``[1]``, ``("metrics", "approach", ...)`` ``[P]`` and ``("metrics", "episode", ...)`` ``[1]``, final at the last
      step.

    A CV that leaves the region is terminated (value zero); at the episode's end everyone still present is truncated
    (bootstrap). The episode's ``return`` is the sum over steps of the mean reward over the agents that acted.
    """

    def __init__(
        self,
        contexts: Contexts | None = None,
        *,
        config: EnvConfig | None = None,
        seed: int = 0,
        worker: int | None = None,
        num_workers: int = 1,
        simulator: str = "sumo",
    ) -> None:
        config = checked_config(config)
        numbers = numbering(worker, num_workers, 1, seed, name="worker")
        super().__init__(contexts, config, seed, [], simulator_of(simulator).make_backend(config), *numbers)

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        context: Context | None = None,
        seed: int | None = None,
        episode: Requested | None = None,
        **options: Any,
    ) -> TensorDictBase:
        if context is None and seed is None:
            return super()._reset(tensordict, episode=episode, **options)
        if context is not None and not isinstance(context, Context):
            raise IzooError(f"reset(context=...) is a {type(context).__name__}; give an izoo Context.")
        if seed is not None:
            check_seed(seed)
        requested = self._requested(episode)
        with self.used_by_one_thread():
            number = self._take_number(0) if requested is None else requested[0]
            planned, planned_seed = self.schedule(number) if context is None else (context, 0)
            self.backend.begin({0: Play(planned, planned_seed if seed is None else seed, number)})
            return self._frame()
