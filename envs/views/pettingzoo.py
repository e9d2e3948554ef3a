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
from izoo.envs.views.commands import Commands, action_space, read_action
from izoo.envs.views.controlled_vehicles import first_with_cvs
from izoo.envs.views.view_session import OPTIONS, View, ViewSession
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


class EcoDrivingParallel(View, ParallelEnv):  # type: ignore[misc]
    """One intersection whose agents appear and leave, under PettingZoo's parallel API.

    - Agents are named ``cv_<number>`` by the vehicle's number in the episode's demand, so a vehicle has the same name
      under every policy. ``possible_agents`` are the names up to ``max_vehicles``.
    - Observation: ``[F]`` float32 (columns in :attr:`observation_names`). Action: ``[1]``, acceleration in m/s^2,
      clipped to [-4.5, 2.6]; NaN leaves the CV uncommanded and is counted, ``None`` is not. With ``config.lane_change``
      a dictionary: this as ``acceleration``, and ``lane_change``, a number (0 right, 1 keep, 2 left). With
      ``config.action`` of ``speed``: ``[D]``, shares of the speed limit, one for each of ``config.action_parts``.
    - Where ``config.decide`` is not ``step``, a step lasts until an agent must decide; ``decides`` of an agent's info
      is true if it must, and the actions of others are not read.
    - :meth:`step` returns entries for the agents that acted and those that entered in the step: an agent that left is
      terminated, with a zero observation (its value is zero) and its last reward; agents present at the horizon are
      truncated, with their last observation; the reward of a new agent is 0.
    - ``agents`` is empty only when the episode is over: steps without any CV are simulated in one go.

    All agents share one observation and one action space, so seeding one seeds those of vehicles yet to come.

    Args:
        contexts: what is played, as for :class:`~izoo.envs.EcoDrivingEnv`.
        config: settings of the environment; ``emit`` and ``gui`` have no effect.
        seed: base seed of the episodes; ``reset(seed=...)`` sets another one and begins with its first episode.
        render_mode: ``rgb_array`` (a top view; no screen is needed) or ``human`` (sumo-gui).
        max_vehicles: length of ``possible_agents``. An episode's vehicles are numbered in order of departure; CVs with
            higher numbers are left uncommanded, with a warning.
        in_process: simulate in this process instead of a separate one: faster, but a process can hold only one such
            environment.
        simulator: ``sumo``, or ``twin``, its compiled copy, any number of which run in this process.
    """

    metadata: dict[str, Any] = {"name": "izoo_eco_driving_v0", "is_parallelizable": True}  # noqa: RUF012

    def __init__(
        self,
        contexts: Contexts | None = None,
        config: EnvConfig | None = None,
        seed: int = 0,
        render_mode: str | None = None,
        *,
        max_vehicles: int = 4096,
        in_process: bool = False,
        simulator: str = "sumo",
    ) -> None:
        check_whole("max_vehicles", max_vehicles, 1, 10**6)
        self._open(ViewSession(contexts, config, seed, render_mode, in_process, simulator))
        self.possible_agents = [f"cv_{number}" for number in range(max_vehicles)]
        self.agents: list[str] = []
        self._slot: dict[str, int] = {}
        self._unnamed_cvs = False
        self._observation_space = spaces.Box(-np.inf, np.inf, (len(self.observation_names),), np.float32)
        self._action_space = action_space(self.config, None)
        p = self.config.num_approaches
        sizes = {
            "vehicles": self.config.num_vehicles * len(VEHICLE_COLUMNS),
            "signal_colour": p * p,
            "signal_time_left_s": p * p,
            "context": len(self.session.frame["context_values"]),
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
        """Begin an episode, the next one without a seed, and simulate until there is a CV.

        If by chance no CV enters, the next episode is begun: ``episode`` and ``episode_seed`` of an agent's info are
        those of the episode that is played. With the option ``context`` the next ``episode_seed`` is played.

        Options are those of :data:`izoo.envs.views.view_session.OPTIONS`. Others are ignored with a warning, because
        PettingZoo's own test passes one.

        Raises:
            IzooError: no CV can ever enter, or none of those that entered is a possible agent.
        """
        known = {name: value for name, value in (options or {}).items() if name in OPTIONS}
        for name in (options or {}).keys() - known.keys():
            warnings.warn(f"{unknown_choice('reset option', name, OPTIONS)} It is ignored.", stacklevel=2)
        self.session.begin(seed, known)
        self._advance_to_agents()
        while not self.agents:
            if self._unnamed_cvs:
                raise IzooError(
                    f"all CVs of the episode have numbers beyond the {len(self.possible_agents)} possible agents; "
                    "raise max_vehicles."
                )
            if "context" in known:
                first_with_cvs(self.config, [(0, known["context"])])
                self.session.begin(options={**known, "episode_seed": self.session.episode_seed + 1})
            else:
                self.session.begin_next_with_cvs()
            self._advance_to_agents()
        return self._observe(self.agents), {
            agent: {**self._info(agent), **self.session.number()} for agent in self.agents
        }

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[AgentDict, dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Simulate a step with an action for every live agent; once the episode is over, return empty dictionaries.

        Raises:
            IzooError: an agent is missing or not alive, or an action has another shape or type.
        """
        if self.session.over and self.session.context is not None and not actions:
            return {}, {}, {}, {}, {}
        self.session.require_running()
        commands = self._commands(actions)
        acted, slots = self.agents, self._slot
        self.session.step(commands)
        frame = self.session.frame
        rewards = {agent: float(frame["reward"][slots[agent]]) for agent in acted}
        terminated = {agent: bool(frame["agent_terminated"][slots[agent]]) for agent in acted}
        infos = {
            agent: {**self._info(agent), "reward_vector": frame["reward_vector"][slots[agent]].copy()}
            for agent in acted
        }
        observations = self._observe(acted)
        self._find_agents()
        if not self.agents:
            self._advance_while_empty()
        entered = [agent for agent in self.agents if agent not in rewards]
        observations |= self._observe(entered)
        infos |= {agent: self._info(agent) for agent in entered}
        rewards |= dict.fromkeys(entered, 0.0)
        terminated |= dict.fromkeys(entered, False)
        truncated = {agent: self.session.over and not left for agent, left in terminated.items()}
        if self.session.over:
            self.agents = []
        return observations, rewards, terminated, truncated, infos

    def state(self) -> np.ndarray:
        """Return the global state, float32, unscaled.

        :attr:`state_layout` says where its parts lie: ``vehicles``, ``[V, len(VEHICLE_COLUMNS)]`` row by row, all
        vehicles of the region in the columns :data:`VEHICLE_COLUMNS`; ``signal_colour`` and ``signal_time_left_s``,
        ``[P, P]`` by approach and exit (0 green, 1 yellow, 2 red); ``context``, in the columns
        :data:`izoo.envs.mdp.frame.CONTEXT_VALUES`.
        """
        if self.session.context is None:
            raise IzooError("state() came before reset(); call reset() first, it starts the episode.")
        frame = self.session.frame
        vehicles = np.concatenate([frame["vehicle_floats"], frame["vehicle_ints"], frame["vehicle_flags"]], axis=1)
        parts = (vehicles, frame["signal_colour"], frame["signal_time_left_s"], frame["context_values"])
        return np.concatenate([part.ravel() for part in parts]).astype(np.float32)

    def plan(self) -> dict[str, Any]:
        """Return the present episode: ``context`` (its name), ``episode`` and ``episode_seed``.

        Agents' infos hold numbers alone, since libraries put them into arrays.
        """
        return self.session.plan()

    def metrics(self) -> dict[str, dict[str, Any]]:
        """Return the metrics of the ended episode (:meth:`izoo.envs.views.view_session.ViewSession.metrics`).

        Raises:
            IzooError: no episode has ended.
        """
        if self.session.context is None or not self.session.over:
            raise IzooError("metrics() needs an episode that has ended; step until `agents` is empty.")
        return self.session.metrics()

    def _commands(self, actions: Mapping[str, Any]) -> Commands:
        """Return the commands of the agents' actions."""
        strangers, missing = sorted(actions.keys() - self._slot.keys()), sorted(self._slot.keys() - actions.keys())
        if strangers:
            raise IzooError(f"{', '.join(strangers[:3])} cannot act: no live agent; give actions for env.agents only.")
        if missing:
            raise IzooError(f"actions lacks {', '.join(missing[:3])}; give one for all env.agents (None: uncommanded).")
        commands = self.session.commands()
        for agent, value in actions.items():
            if value is not None:
                slot = self._slot[agent]
                numbers, lane_change = read_action(self.config, value, None, f"the action of {agent}")
                commands.action[slot], commands.lane_change[slot] = numbers[0], lane_change[0]
                commands.defer[slot] = False
        return commands

    def _find_agents(self) -> None:
        """Update the agents from the CVs in the region, in order of their numbers."""
        numbers = self.session.numbers
        named = {int(number): slot for slot, number in enumerate(numbers.tolist()) if number >= 0}
        if any(number >= len(self.possible_agents) for number in named):
            named = {number: slot for number, slot in named.items() if number < len(self.possible_agents)}
            self._unnamed_cvs = True
            warnings.warn(
                f"CVs beyond the {len(self.possible_agents)} possible agents are left uncommanded; raise max_vehicles.",
                stacklevel=3,
            )
        self._slot = {f"cv_{number}": named[number] for number in sorted(named)}
        self.agents = list(self._slot)

    def _advance_to_agents(self) -> None:
        """Find the first agents of an episode, if there are any."""
        self._slot, self._unnamed_cvs = {}, False
        self._find_agents()
        self._advance_while_empty()

    def _advance_while_empty(self) -> None:
        """Simulate while there are no agents."""
        while not self.agents and not self.session.over:
            self.session.step(self.session.commands())
            self._find_agents()
        if self.session.over:
            self.agents = []

    def _observe(self, agents: list[str]) -> AgentDict:
        observation = self.session.frame["observation"]
        return {agent: observation[self._slot[agent]].copy() for agent in agents}

    def _info(self, agent: str) -> dict[str, Any]:
        slot = self._slot[agent]
        info = {"time_s": self.session.time_s, "slot": slot}
        return info if self.config.decide == STEP else info | {"decides": bool(self.session.decides[slot])}


parallel_env = EcoDrivingParallel
"""PettingZoo's name for what makes an environment."""
