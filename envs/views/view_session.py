"""The simulation behind a Gymnasium or PettingZoo view: its episodes, its frame, its process.

Only NumPy is needed here, so that processes that step such a view stay small.
"""

from __future__ import annotations

import dataclasses
import warnings
import weakref
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from izoo.contexts.context import Context
from izoo.contexts.procedural import ProceduralSource
from izoo.contexts.source import as_schedule, reseed
from izoo.envs import REFERENCE, simulator_of
from izoo.envs.backend import Backend, Play
from izoo.envs.config import KEEP_LANE, STEP, EnvConfig, checked_config
from izoo.envs.mdp.columns import VEHICLE_INTS
from izoo.envs.mdp.frame import observation_names, row_of
from izoo.envs.mdp.metric_sums import APPROACH_METRICS, EPISODE_METRIC, EPISODE_METRICS
from izoo.envs.render import draw
from izoo.envs.sumo.session import has_screen
from izoo.envs.sumo.workers import SumoWorkers
from izoo.envs.views.commands import Commands
from izoo.envs.views.controlled_vehicles import EPISODES_SEARCHED, first_with_cvs
from izoo.errors import IzooError, check_choice, check_seed, unknown_choice

if TYPE_CHECKING:
    from izoo.envs.env import Contexts

RENDER_MODES = ("rgb_array", "human")
OPTIONS = ("context", "episode_seed", "episode")
"""Options of a view's ``reset``: play ``context`` (with ``episode_seed``, default 0), or the ``episode`` of this number
of the schedule (with its own seed, or ``episode_seed``)."""


class ViewSession:
    """Runs numbered episodes in a process of its own, or in this one, and holds the frame.

    Args:
        contexts: as for :class:`~izoo.envs.EcoDrivingEnv`.
        config: settings of the environment; ``emit`` and ``gui`` are chosen here.
        seed: base seed.
        render_mode: ``None`` or one of :data:`RENDER_MODES`; ``human`` opens sumo-gui.
        in_process: simulate in this process, which can then hold no other SUMO simulation.
        simulator: ``sumo``, or ``twin``, which always runs in this process.

    Attributes:
        frame: the arrays of :func:`izoo.envs.mdp.frame.frame_fields`, of one environment.
        context: the present context; ``None`` before the first episode.
        over: whether the episode has ended.
    """

    def __init__(
        self,
        contexts: Contexts | None,
        config: EnvConfig | None,
        seed: int,
        render_mode: str | None,
        in_process: bool,
        simulator: str = "sumo",
    ) -> None:
        chosen = simulator_of(simulator)
        if render_mode is not None:
            check_choice("render_mode", render_mode, RENDER_MODES)
        if render_mode == "human" and not chosen.window:
            raise IzooError(f"render_mode='human' needs a window, and {chosen.label} has none; use 'rgb_array'.")
        if render_mode == "human" and not has_screen():
            raise IzooError("render_mode='human' needs a screen, and DISPLAY is not set; use render_mode='rgb_array'.")
        config = checked_config(config)
        self.config = dataclasses.replace(
            config, emit=("vehicles", "signal", "reward_vector"), gui=render_mode == "human"
        )
        self.render_mode = render_mode
        self.schedule = as_schedule(ProceduralSource() if contexts is None else contexts, check_seed(seed))
        self.context: Context | None = None
        self.over = True
        self.steps = 0
        self.episode, self.episode_seed = -1, 0
        self._next_episode = 0
        self._in_process, self._simulator = in_process, simulator
        self._make_backend()

    def _make_backend(self) -> None:
        chosen = simulator_of(self._simulator)
        here = self._in_process or self._simulator != REFERENCE
        self._backend: Backend = chosen.make_backend(self.config) if here else SumoWorkers(self.config, 1, poll=False)
        self.frame = row_of(self._backend.frames, 0)
        self._finalizer = weakref.finalize(self, self._backend.close)

    def __getstate__(self) -> dict[str, Any]:
        """Return what makes an equal session; only one that has not begun can be copied.

        Raises:
            IzooError: an episode has begun.
        """
        if self.context is not None:
            raise IzooError("a view whose episode has begun cannot be copied or pickled; do so before reset().")
        held = ("_backend", "_finalizer", "frame")
        return {name: value for name, value in vars(self).items() if name not in held}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._make_backend()

    def begin(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> None:
        """Begin an episode: the first one of a new base ``seed``, the one given by ``options``, or the next one.

        Raises:
            IzooError: an unknown option or an unusable value.
        """
        options = options or {}
        for name in options:
            if name not in OPTIONS:
                raise unknown_choice("reset option", name, OPTIONS)
        for name in {"episode", "episode_seed"} & options.keys():
            check_seed(options[name], f"the reset option {name!r}")
        context = options.get("context")
        if "context" in options and not isinstance(context, Context):
            raise IzooError(f"the reset option 'context' is a {type(context).__name__}; give an izoo Context.")
        if seed is not None:
            self.schedule, self._next_episode = reseed(self.schedule, check_seed(seed)), 0
        if context is not None:
            episode_seed, episode = 0, -1
        else:
            episode = int(options.get("episode", self._next_episode))
            context, episode_seed = self.schedule(episode)
            self._next_episode = episode + 1
        episode_seed = int(options.get("episode_seed", episode_seed))
        self.over = True
        if not self._finalizer.alive:
            self._make_backend()
        self._backend.begin({0: Play(context, episode_seed, episode)})
        self.context, self.episode, self.episode_seed, self.steps = context, episode, episode_seed, 0
        self.over = False

    def begin_next_with_cvs(self) -> None:
        """Begin the next episode in which a CV can enter.

        Raises:
            IzooError: there is none within :data:`EPISODES_SEARCHED` episodes.
        """
        numbers = range(self._next_episode, self._next_episode + EPISODES_SEARCHED)
        number = first_with_cvs(self.config, ((number, self.schedule(number)[0]) for number in numbers))
        self.begin(options={"episode": number})

    def commands(self) -> Commands:
        """Return commands that leave every CV uncommanded, to be filled in."""
        count = self.config.num_agents
        action = np.zeros((count, self.config.action_size), np.float32)
        return Commands(action, np.ones(count, bool), np.full(count, KEEP_LANE, np.int64))

    def step(self, commands: Commands) -> None:
        """Simulate one step.

        Raises:
            IzooError: no episode is running.
            RuntimeError: the simulation's process was lost.
        """
        self.require_running()
        for name, values in commands._asdict().items():
            self.frame[name][:] = values
        self.over = True  # unless the step succeeds
        if self._backend.step():
            raise RuntimeError("the simulation was lost; call reset(), which begins anew in a new process.")
        self.steps += 1
        self.over = bool(self.frame["truncated"][0])

    def require_running(self) -> None:
        """Raise :class:`IzooError` unless an episode is running."""
        if self.context is None:
            raise IzooError("step() came before reset(); call reset() first, which starts the episode.")
        if self.over:
            raise IzooError("step() came after the end of the episode; call reset(), which starts the next one.")

    def close(self) -> None:
        """End the simulation; a later :meth:`begin` starts it again."""
        self.context, self.over = None, True
        self._finalizer()

    @property
    def mask(self) -> np.ndarray:
        """Slots that hold a CV, ``[A]`` bool."""
        return self.frame["mask"].astype(bool)

    @property
    def decides(self) -> np.ndarray:
        """Slots whose CV must decide now, ``[A]`` bool; the actions of others are not read."""
        return self.mask if self.config.decide == STEP else self.frame["decides"].astype(bool)

    @property
    def numbers(self) -> np.ndarray:
        """Number in the episode's demand of the CV in every slot, ``[A]`` int64; -1 where there is none."""
        number = self.frame["vehicle_ints"][self.frame["agent_vehicle"], VEHICLE_INTS.index("vehicle_number")]
        return np.where(self.mask, number, -1).astype(np.int64)

    @property
    def time_s(self) -> float:
        """Simulated time, warm-up included."""
        simulated = round(float(self.frame["episode_metrics"][EPISODE_METRIC["steps"]]))
        return (self.config.warmup_steps + simulated) * self.config.step_s

    @property
    def fps(self) -> int:
        """Pictures per second for playback in real time, one per decision; at least 1."""
        return max(round(1.0 / self.config.decision_s), 1)

    def metrics(self) -> dict[str, dict[str, Any]]:
        """Return the ended episode's ``{"approach": {name: [P]}, "episode": {name: number}}``."""
        approach, episode = self.frame["approach_metrics"], self.frame["episode_metrics"]
        return {
            "approach": {name: approach[:, column].copy() for column, name in enumerate(APPROACH_METRICS)},
            "episode": {name: float(episode[column]) for column, name in enumerate(EPISODE_METRICS)},
        }

    def number(self) -> dict[str, int]:
        """Return the episode's number and seed."""
        return {"episode": self.episode, "episode_seed": self.episode_seed}

    def plan(self) -> dict[str, Any]:
        """Return the context's name, and the episode's number and seed."""
        name = "" if self.context is None else self.context.name
        return {"context": name, **self.number()}

    def info(self) -> dict[str, Any]:
        """Return the time, and at the episode's end the metrics."""
        return {"time_s": self.time_s, "metrics": self.metrics()} if self.over else {"time_s": self.time_s}

    def render(self, span_m: float = 120.0, size_px: int = 640) -> np.ndarray:
        """Return a top view ``[size_px, size_px, 3]`` uint8; no screen is needed."""
        if self.context is None:
            raise IzooError("render() came before reset(); call reset() first, which starts the episode.")
        return draw(self._backend.scene(), span_m=span_m, size_px=size_px)


class View:
    """What views of all kinds have: a session, and pictures of it.

    Attributes:
        session: the simulation.
        config: settings of the environment.
        observation_names: names of the columns of an observation.
    """

    metadata: dict[str, Any]

    def _open(self, session: ViewSession) -> None:
        """Take up a session; the metadata of the class name all render modes, those of a view the available ones."""
        self.session, self.config, self.render_mode = session, session.config, session.render_mode
        modes = list(RENDER_MODES) if has_screen() else ["rgb_array"]
        self.metadata = {**type(self).metadata, "render_modes": modes, "render_fps": session.fps}
        self.observation_names = observation_names(session.config)

    def render(self) -> np.ndarray | None:
        """Return a picture ``[640, 640, 3]`` uint8 with ``rgb_array``; ``None`` otherwise."""
        if self.render_mode is None:
            warnings.warn("render() needs a render mode; give render_mode='rgb_array'.", stacklevel=2)
        return self.session.render() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """End the simulation."""
        self.session.close()
