"""PettingZoo view: every controlled vehicle (CV) is an agent from entering the region until it leaves.

The simulation is that of :class:`~izoo.envs.EcoDrivingEnv`: the same context, seed and actions give the same
trajectories.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from izoo.envs.config import STEP, EnvConfig
from izoo.envs.mdp.columns import VEHICLE_FLAGS, VEHICLE_FLOATS, VEHICLE_INTS
from izoo.envs.mdp.frame import observation_names
from izoo.envs.views.actions import Commands, action_space, read_action
from izoo.envs.views.barren import first_fertile
from izoo.envs.views.view_session import OPTIONS, Host, render_modes
from izoo.errors import IzooError, check_whole, unknown_choice

try:
    from pettingzoo import ParallelEnv
except ImportError as _error:
    raise ImportError("izoo.envs.views.pettingzoo needs PettingZoo; run: pip install 'izoo[pettingzoo]'") from _error

if TYPE_CHECKING:
    from izoo.envs.env import Contexts

AgentDict = dict[str, Any]
VEHICLE_COLUMNS = (*VEHICLE_FLOATS, *VEHICLE_INTS, *VEHICLE_FLAGS)
"""Columns of a vehicle's row in :meth:`EcoDrivingParallel.state`; a row whose ``present`` is 0 is empty."""


def parallel_env(
    contexts: Contexts | None = None,
    config: EnvConfig | None = None,
    seed: int = 0,
    render_mode: str | None = None,
    *,
    max_vehicles: int = 4096,
    in_process: bool = False,
    simulator: str = "sumo",
) -> EcoDrivingParallel:
    """Return one intersection under PettingZoo's parallel API.

    Args:
        contexts: what is played, as for :class:`~izoo.envs.EcoDrivingEnv`.
        config: settings of the environment; ``emit`` and ``gui`` have no effect.
        seed: base seed of the episodes; ``reset(seed=...)`` sets another one and begins with its first episode.
        render_mode: ``rgb_array`` (a top view; no screen is needed) or ``human`` (sumo-gui).
        max_vehicles: length of ``possible_agents``. An episode's vehicles are numbered in order of departure; CVs with
            higher numbers are left to SUMO, with a warning.
        in_process: simulate in this process instead of one of the environment's own: faster, but a process can hold
            only one such environment.
        simulator: ``sumo``, or ``twin``, its compiled copy, which runs in this process beside any others.
    """
    return EcoDrivingParallel(
        contexts, config, seed, render_mode, max_vehicles=max_vehicles, in_process=in_process, simulator=simulator
    )


class EcoDrivingParallel(ParallelEnv):  # type: ignore[misc]
    """One intersection whose agents appear and leave; :func:`parallel_env` makes it.

    - Agents are named ``cv_<number>`` by the vehicle's number in the episode's demand, so a vehicle has the same name
      whatever the policy does. ``possible_agents`` are the names up to ``max_vehicles``.
    - Observation: ``[F]`` float32 (columns in :attr:`observation_names`). Action: ``[1]``, acceleration in m/s^2, cut
      to [-4.5, 2.6]; NaN leaves the CV to SUMO and is counted, ``None`` leaves it to SUMO. With ``config.lane_change``
      a dictionary: this as ``acceleration``, and ``lane_change``, a number (0 right, 1 keep, 2 left). With
      ``config.action`` of ``speed``: ``[D]``, shares of the speed limit, one for each of ``config.action_parts``.
    - Where ``config.decide`` is not ``step``, a step lasts until an agent is to decide; ``decides`` of an agent's info
      says whether it is, and the actions of others are not read.
    - What :meth:`step` returns speaks of the agents that acted and of those that entered in the step: an agent that
      left is terminated, with a zero observation (its value is zero) and its last reward; those present at the horizon
      are truncated, with their last observation; a newcomer's reward is 0.
    - ``agents`` is empty only when the episode is over: steps in which there is no CV are simulated in one go.

    All agents share one observation and one action space, so seeding one seeds those of vehicles yet to come.
    """

    metadata: dict[str, Any] = {"name": "izoo_eco_driving_v0", "is_parallelizable": True}  # noqa: RUF012

    def __init__(
        self,
        contexts: Contexts | None,
        config: EnvConfig | None,
        seed: int,
        render_mode: str | None,
        *,
        max_vehicles: int,
        in_process: bool,
        simulator: str,
    ) -> None:
        check_whole("max_vehicles", max_vehicles, 1, 10**6)
        self.host = Host(contexts, config, seed, render_mode, in_process, simulator)
        self.config, self.render_mode = self.host.config, render_mode
        self.metadata = {**type(self).metadata, "render_modes": render_modes(), "render_fps": self.host.fps}
        self.observation_names = observation_names(self.config)
        self.possible_agents = [f"cv_{number}" for number in range(max_vehicles)]
        self.agents: list[str] = []
        self._slot: dict[str, int] = {}
        self._nameless = False
        self._observation_space = spaces.Box(-np.inf, np.inf, (len(self.observation_names),), np.float32)
        self._action_space = action_space(self.config, None)
        p = self.config.num_approaches
        sizes = {
            "vehicles": self.config.num_vehicles * len(VEHICLE_COLUMNS),
            "signal_colour": p * p,
            "signal_time_left_s": p * p,
            "context": len(self.host.frame["context_values"]),
        }
        ends = np.cumsum(list(sizes.values())).tolist()
        self.state_layout = {name: slice(end - sizes[name], end) for name, end in zip(sizes, ends, strict=True)}
        self.state_space = spaces.Box(-np.inf, np.inf, (ends[-1],), np.float32)

    def observation_space(self, agent: str) -> spaces.Box:
        """Return the observation space, the same for all agents."""
        return self._observation_space

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return the action space, the same for all agents."""
        return self._action_space

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[AgentDict, dict[str, dict[str, Any]]]:
        """Begin an episode and drive on until there is a CV; without a seed, the next one.

        An episode in which, by chance, no CV comes is over before it begins for agents, and the next one is begun:
        ``episode`` and ``episode_seed`` of an agent's info say which it is. Of a ``context`` that the options name, the
        next ``episode_seed`` is played.

        Options are those of :data:`izoo.envs.views.view_session.OPTIONS`. Others are ignored with a warning, because
        PettingZoo's own test passes one.

        Raises:
            IzooError: no CV can ever come, or none of those that came is a possible agent.
        """
        known = {name: value for name, value in (options or {}).items() if name in OPTIONS}
        for name in (options or {}).keys() - known.keys():
            warnings.warn(f"{unknown_choice('reset option', name, OPTIONS)} It is ignored.", stacklevel=2)
        self.host.begin(seed, known)
        self._come_to_agents()
        while not self.agents:
            if self._nameless:
                raise IzooError(
                    f"all CVs of the episode have numbers beyond the {len(self.possible_agents)} possible agents; "
                    "raise max_vehicles."
                )
            if "context" in known:
                first_fertile(self.config, [(0, known["context"])])
                self.host.begin(options={**known, "episode_seed": self.host.episode_seed + 1})
            else:
                self.host.begin_another()
            self._come_to_agents()
        return self._observe(self.agents), {agent: {**self._info(agent), **self.host.number()} for agent in self.agents}

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[AgentDict, dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Simulate a step in which every live agent has its action of ``actions``; nothing, once the episode is over.

        Raises:
            IzooError: an agent is missing or not alive, or an action has another shape or type.
        """
        if self.host.over and self.host.context is not None and not actions:
            return {}, {}, {}, {}, {}
        self.host.require_running()
        commands = self._commands(actions)
        acted, slots = self.agents, self._slot
        self.host.step(commands)
        frame = self.host.frame
        rewards = {agent: float(frame["reward"][slots[agent]]) for agent in acted}
        terminated = {agent: bool(frame["agent_terminated"][slots[agent]]) for agent in acted}
        infos = {
            agent: {**self._info(agent), "reward_vector": frame["reward_vector"][slots[agent]].copy()}
            for agent in acted
        }
        observations = self._observe(acted)
        self._find_agents()
        if not self.agents:
            self._pass_time()
        newcomers = [agent for agent in self.agents if agent not in rewards]
        observations |= self._observe(newcomers)
        infos |= {agent: self._info(agent) for agent in newcomers}
        rewards |= dict.fromkeys(newcomers, 0.0)
        terminated |= dict.fromkeys(newcomers, False)
        truncated = {agent: self.host.over and not left for agent, left in terminated.items()}
        if self.host.over:
            self.agents = []
        return observations, rewards, terminated, truncated, infos

    def state(self) -> np.ndarray:
        """Return the global state, float32, unscaled.

        :attr:`state_layout` says where its parts lie: ``vehicles``, ``[V, len(VEHICLE_COLUMNS)]`` row by row, all
        vehicles of the region in the columns :data:`VEHICLE_COLUMNS`; ``signal_colour`` and ``signal_time_left_s``,
        ``[P, P]`` by approach and exit (0 green, 1 yellow, 2 red); ``context``, in the columns
        :data:`izoo.envs.mdp.frame.CONTEXT_VALUES`.
        """
        if self.host.context is None:
            raise IzooError("state() came before reset(); call reset() first, it starts the episode.")
        frame = self.host.frame
        vehicles = np.concatenate([frame["vehicle_floats"], frame["vehicle_ints"], frame["vehicle_flags"]], axis=1)
        parts = (vehicles, frame["signal_colour"], frame["signal_time_left_s"], frame["context_values"])
        return np.concatenate([part.ravel() for part in parts]).astype(np.float32)

    def plan(self) -> dict[str, Any]:
        """Return what is being played: ``context`` (its name), ``episode`` and ``episode_seed``.

        Agents' infos hold numbers alone, since libraries put them into arrays.
        """
        return self.host.plan()

    def metrics(self) -> dict[str, dict[str, Any]]:
        """Return the metrics of the episode that has ended; see :meth:`izoo.envs.views.view_session.Host.metrics`.

        Raises:
            IzooError: no episode has ended.
        """
        if self.host.context is None or not self.host.over:
            raise IzooError("metrics() are those of an episode that has ended; step until `agents` is empty.")
        return self.host.metrics()

    def render(self) -> np.ndarray | None:
        """Return a picture ``[640, 640, 3]`` uint8 with ``rgb_array``; sumo-gui shows itself."""
        if self.render_mode is None:
            warnings.warn("render() needs a render mode; give parallel_env(render_mode='rgb_array').", stacklevel=2)
        return self.host.render() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """End the simulation."""
        self.host.close()

    def _commands(self, actions: Mapping[str, Any]) -> Commands:
        """Return what the agents' actions come to."""
        strangers, missing = sorted(actions.keys() - self._slot.keys()), sorted(self._slot.keys() - actions.keys())
        if strangers:
            raise IzooError(f"{', '.join(strangers[:3])} cannot act, being no live agent; act for env.agents alone.")
        if missing:
            raise IzooError(f"actions lacks {', '.join(missing[:3])}; act for all env.agents (None: SUMO drives).")
        commands = self.host.commands()
        for agent, value in actions.items():
            if value is not None:
                slot = self._slot[agent]
                numbers, lane_change = read_action(self.config, value, None, f"the action of {agent}")
                commands.action[slot], commands.lane_change[slot] = numbers[0], lane_change[0]
                commands.defer[slot] = False
        return commands

    def _find_agents(self) -> None:
        """Name the CVs that are there, in order of their numbers."""
        numbers = self.host.numbers
        named = {int(number): slot for slot, number in enumerate(numbers.tolist()) if number >= 0}
        if any(number >= len(self.possible_agents) for number in named):
            named = {number: slot for number, slot in named.items() if number < len(self.possible_agents)}
            self._nameless = True
            warnings.warn(
                f"CVs beyond the {len(self.possible_agents)} possible agents are left to SUMO; raise max_vehicles.",
                stacklevel=3,
            )
        self._slot = {f"cv_{number}": named[number] for number in sorted(named)}
        self.agents = list(self._slot)

    def _come_to_agents(self) -> None:
        """From the beginning of an episode, find the first agents, if there will be any."""
        self._slot, self._nameless = {}, False
        self._find_agents()
        self._pass_time()

    def _pass_time(self) -> None:
        """Simulate while there is nobody to act."""
        while not self.agents and not self.host.over:
            self.host.step(self.host.commands())
            self._find_agents()
        if self.host.over:
            self.agents = []

    def _observe(self, agents: list[str]) -> AgentDict:
        observation = self.host.frame["observation"]
        return {agent: observation[self._slot[agent]].copy() for agent in agents}

    def _info(self, agent: str) -> dict[str, Any]:
        slot = self._slot[agent]
        info = {"time_s": self.host.time_s, "slot": slot}
        return info if self.config.decide == STEP else info | {"decides": bool(self.host.decides[slot])}
