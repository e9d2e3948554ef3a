"""The environment: one intersection on libsumo, in this process, as a TorchRL environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from izoo.contexts.context import Context
from izoo.contexts.procedural import ProceduralSource
from izoo.contexts.source import ContextSource, Schedule, as_schedule, reseed
from izoo.emissions.weights import load_weights
from izoo.envs import specs
from izoo.envs.config import EnvConfig
from izoo.envs.layout import frame_bytes, map_frames, observation_names
from izoo.envs.reader import FrameReader
from izoo.envs.recorder import BatchRecorder
from izoo.envs.sumo.simulator import Simulator
from izoo.errors import IzooError

Contexts = Context | Sequence[Context] | ContextSource | Schedule


class EcoDrivingBase(EnvBase):
    """Specs and frames, shared by the single and the parallel environment.

    Args:
        contexts: what is played: a context, a sequence or a source to draw from, or a schedule; the default draws from
            the procedural training ranges of the systematicity protocol.
        config: settings of the environment.
        seed: base seed; with an episode's number it determines the episode's context and seed.
        batch_size: ``[]`` or ``[N]``.
        buffer: memory for the frames.
    """

    batch_locked = True
    leaves: tuple[str, ...] = ()
    """Arrays of a frame that are emitted at the root, besides the groups of ``config.emit``."""

    def __init__(
        self, contexts: Contexts | None, config: EnvConfig | None, seed: int, batch_size: list[int], buffer: Any
    ) -> None:
        super().__init__(device=None, batch_size=torch.Size(batch_size))
        self.is_closed = False  # TorchRL closes only what says that it is open
        self.config = config = config or EnvConfig()
        self.schedule = as_schedule(ProceduralSource() if contexts is None else contexts, seed)
        self.frames = map_frames(buffer, config, *(batch_size or [1]))
        views = self.frames if batch_size else {name: array[0] for name, array in self.frames.items()}
        self.reader = FrameReader(config, views, self.batch_size, self.leaves)
        self.observation_names = observation_names(config)
        self.group_map = {"agents": [f"agent_{k}" for k in range(config.num_agents)]}
        self.observation_spec = specs.observation_spec(config, self.batch_size)
        self.action_spec = specs.action_spec(config, self.batch_size)
        self.reward_spec = specs.reward_spec(config, self.batch_size)
        self.done_spec = specs.done_spec(config, self.batch_size)
        if "context" in config.emit:
            self.state_spec = specs.Composite(context=specs.context_spec(self.batch_size), shape=self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.schedule = reseed(self.schedule, seed)
            self._restart_episodes()

    @property
    def started(self) -> bool:
        """Whether the episodes are running."""
        raise NotImplementedError

    def _restart_episodes(self) -> None:
        """Number episodes from the first again."""
        raise NotImplementedError

    def _advance(self, state: Callable[[], TensorDictBase]) -> None:
        """Bring the frames, which hold the commands, to what follows.

        Args:
            state: returns what was acted on.
        """
        raise NotImplementedError

    def _simulate(self, tensordict: TensorDictBase) -> None:
        """Take the actions and bring the frames to what follows."""
        self.require_started()
        self.reader.write_action(tensordict)
        self._advance(lambda: tensordict)

    def require_started(self) -> None:
        """Raise :class:`IzooError` unless the episodes are running."""
        if not self.started:
            raise IzooError("step() came before reset(); call reset() first, it starts the episodes.")

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._simulate(tensordict)
        return self.reader.read()[0]

    def _frame(self) -> TensorDict:
        return self.reader.read()[1]

    def step_lean(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Step, and return what is set under ``"next"``: ``step`` without its checks."""
        following = self._step(tensordict)
        _set(tensordict, "next", following)
        return following

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Step, and begin new episodes where one has ended; return the step and the state to act on next.

        The same as TorchRL's own, but lean (:meth:`step_lean`).
        """
        self._simulate(tensordict)
        following, state = self.reader.read()
        _set(tensordict, "next", following)
        begun = self._begin_where_ended()
        return tensordict, state if begun is None else begun

    def step_recorded(self, recorder: BatchRecorder, step: int) -> None:
        """Take the commands of a step from a recorder's batch, and write what follows into it.

        Does what :meth:`step_and_maybe_reset` does, without TensorDicts.
        """
        self.reader.write_commands(recorder.commands, step)
        self._advance(lambda: recorder.state(step))
        recorder.write_following(step)
        self._begin_where_ended()
        recorder.write_state(step + 1)

    def _begin_where_ended(self) -> TensorDictBase | None:
        """Begin new episodes where one has ended; return the state to act on if there was any."""
        done = self.frames["done"]
        if b"\1" not in done.tobytes():
            return None
        ended = torch.from_numpy(done.astype(bool)).view(*self.batch_size, 1)
        # Not reset(): given the mask alone, it would blank the rows that go on.
        return self._reset(TensorDict._new_unsafe({"_reset": ended}, batch_size=self.batch_size))


def _set(tensordict: TensorDictBase, key: str, value: Any) -> None:
    """Set an entry whose shape is known to be right."""
    tensordict._set_str(key, value, validated=True, inplace=False, non_blocking=False)


class EcoDrivingEnv(EcoDrivingBase):
    """One intersection; SUMO starts at the first reset.

    Worker ``k`` of ``N`` plays the episodes ``k``, ``k + N``, ... of the schedule, so any number of environments play
    the same episodes. ``reset(TensorDict({("context", "episode"): ...}))`` plays a given episode again; ``reset(
    context=..., seed=...)`` plays any context.

    Emits (``A`` agent slots, ``V`` vehicle slots; masks say which slots hold something):

    - ``("agents", "observation")`` ``[A, F]`` (names in :attr:`observation_names`), ``("agents", "mask")`` ``[A]``,
      ``("agents", "vehicle")`` ``[A]``, ``("agents", "reward")`` ``[A, 1]``, and per-agent and root done, terminated
      and truncated.
    - with the groups of ``config.emit``: ``("vehicles", ...)`` ``[V]``, ``("signal", ...)``, ``("context", ...)``
      ``[1]``, ``("metrics", "approach", ...)`` ``[P]`` and ``("metrics", "episode", ...)`` ``[1]``, final at the last
      step.

    A CV that leaves the region is terminated (value zero); at the horizon everyone still present is truncated
    (bootstrap). The episode's ``return`` is the sum over steps of the mean reward over the agents that acted.
    """

    def __init__(
        self,
        contexts: Contexts | None = None,
        *,
        config: EnvConfig | None = None,
        seed: int = 0,
        worker: int = 0,
        num_workers: int = 1,
    ) -> None:
        config = config or EnvConfig()
        super().__init__(contexts, config, seed, [], bytearray(frame_bytes(config, 1)))
        self._first, self._stride = worker, num_workers
        self._restart_episodes()
        self._simulator: Simulator | None = None

    def _restart_episodes(self) -> None:
        self._episode = self._first

    @property
    def simulator(self) -> Simulator:
        """The simulator behind this environment (created when first needed)."""
        if self._simulator is None:
            frame = {name: array[0] for name, array in self.frames.items()}
            self._simulator = Simulator(self.config, frame, load_weights())
        return self._simulator

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        context: Context | None = None,
        seed: int | None = None,
        **_: Any,
    ) -> TensorDictBase:
        requested = None if tensordict is None else tensordict.get(("context", "episode"), None)
        if requested is not None:
            episode = int(requested)
        else:
            episode = self._episode
            self._episode += self._stride
        planned, planned_seed = self.schedule(episode) if context is None else (context, 0)
        self.simulator.reset(planned, planned_seed if seed is None else seed, episode)
        return self._frame()

    @property
    def started(self) -> bool:
        """Whether an episode is running."""
        return self._simulator is not None and self._simulator.started

    def _advance(self, state: Callable[[], TensorDictBase]) -> None:
        self.simulator.step()

    def render(self, *_: Any, span_m: float = 120.0, size_px: int = 640, **__: Any) -> np.ndarray:
        """Return a top view ``[size_px, size_px, 3]`` uint8 of the present state; no screen is needed.

        TorchRL's ``VideoRecorder`` gets its pictures from here through ``PixelRenderTransform``.
        """
        if self._simulator is None or not self._simulator.started:
            raise IzooError("render() came before reset(); call reset() first, it starts the episode.")
        from izoo.envs.views.render import draw

        simulator = self._simulator
        title = f"{simulator.context.name}   t = {simulator.time_s:.1f} s"
        colour = simulator.clock.now
        return draw(simulator.road, simulator.vehicles(), colour, title=title, span_m=span_m, size_px=size_px)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """End SUMO; the process can then open another environment."""
        if self._simulator is not None:
            self._simulator.close()
            self._simulator = None
        if not self.is_closed:
            super().close(raise_if_closed=raise_if_closed)
