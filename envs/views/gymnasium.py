"""Gymnasium views: all controlled vehicles of an intersection as one padded agent, or one of them.

``gymnasium.make("izoo.envs:izoo/EcoDriving-v0")`` makes an :class:`EcoDrivingJoint`, ``"izoo/EcoDrivingEgo-v0"`` an
:class:`EcoDrivingEgo`; the module before the colon is imported first (Gymnasium has no plug-ins since 1.0). They
simulate the same as :class:`~izoo.envs.EcoDrivingEnv`: the same context, seed and actions give the same trajectories.
Each SUMO simulation has a process of its own, so that there can be any number of them; ``gymnasium.make_vec`` steps
them in parallel.

As in Gymnasium, ``reset(seed=s)`` begins the first episode of base seed ``s``, and ``reset()`` the next one; before any
seed, the base seed is random. ``reset(options=...)`` takes those of :data:`izoo.envs.views.view_session.OPTIONS`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from izoo.envs.config import STEP, EnvConfig
from izoo.envs.views.commands import Commands, action_space, read_action
from izoo.envs.views.vector import ViewVector
from izoo.envs.views.view_session import RENDER_MODES, View, ViewSession
from izoo.errors import IzooError

if TYPE_CHECKING:
    from tensordict import TensorDictBase

    from izoo.envs.env import Contexts

    Policy = Callable[[TensorDictBase], TensorDictBase]

Observation = TypeVar("Observation")
WARN_AFTER = 20
"""Consecutive simulations without an ego after which a warning is given."""


class _View(View, gym.Env[Observation, Any]):
    """Base of both views.

    Args:
        contexts: as for :class:`~izoo.envs.EcoDrivingEnv`.
        config: settings of the environment; ``emit`` and ``gui`` have no effect.
        render_mode: ``rgb_array`` (a top view; no screen is needed) or ``human`` (sumo-gui).
        in_process: simulate in this process instead of a separate one: faster, but a process can hold only one such
            environment.
        simulator: ``sumo``, or ``twin``, its compiled copy, any number of which run in this process.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 2}  # noqa: RUF012

    def __init__(
        self,
        contexts: Contexts | None = None,
        config: EnvConfig | None = None,
        render_mode: str | None = None,
        in_process: bool = False,
        simulator: str = "sumo",
    ) -> None:
        seed = int(np.random.SeedSequence().generate_state(1)[0])
        self._open(ViewSession(contexts, config, seed, render_mode, in_process, simulator))


class EcoDrivingJoint(_View[dict[str, np.ndarray]]):
    """All controlled vehicles (CVs) as one agent, in ``A`` slots of ``F`` features, padded.

    - observation: ``observation`` ``[A, F]`` float32 (columns in :attr:`observation_names`; zero in empty slots) and
      ``mask`` ``[A]`` int8: the slot holds a CV. Where ``config.decide`` is not ``step`` also ``decides`` ``[A]`` int8:
      the CV must decide, and the actions of others are not read.
    - action: ``[A]`` accelerations in m/s^2, clipped to [-4.5, 2.6]; NaN leaves a CV uncommanded and is counted. With
      ``config.action`` of ``speed`` shares of the speed limit, ``[A]``, or ``[A, D]`` with ``D`` ``action_parts``. With
      ``config.lane_change`` a dictionary: these as ``acceleration``, and ``lane_change`` ``[A]`` (0 right, 1 keep, 2
      left).
    - reward: the mean over the CVs that acted, 0 if there was none.
    - terminated: never; truncated: the end of the episode.
    - info: ``reward`` ``[A]``, ``reward_vector`` ``[A, R]`` (:data:`izoo.envs.mdp.reward.REWARD_VECTOR`), ``vehicle``
      ``[A]`` (number in the episode's demand, -1 where empty), ``agent_terminated`` ``[A]`` (the CV left: its value is
      zero), ``time_s``; at the episode's end ``metrics``.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        a, f = self.config.num_agents, len(self.observation_names)
        entries: dict[str, Any] = {
            "observation": spaces.Box(-np.inf, np.inf, (a, f), np.float32),
            "mask": spaces.MultiBinary(a),
        }
        if self.config.decide != STEP:
            entries["decides"] = spaces.MultiBinary(a)
        self.observation_space: Any = spaces.Dict(entries)
        self.action_space: Any = action_space(self.config, a)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        self.session.begin(seed, options)
        return self._observation(), {"vehicle": self.session.numbers, **self.session.plan(), **self.session.info()}

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Simulate a step with the actions ``[A]`` (or ``[A, D]``), or the dictionary described above."""
        session, frame = self.session, self.session.frame
        session.require_running()
        numbers, lane_change = read_action(self.config, action, self.config.num_agents)
        acted = session.mask
        session.step(Commands(numbers, np.zeros(self.config.num_agents, bool), lane_change))
        reward = frame["reward"].copy()
        info = {
            "reward": reward,
            "reward_vector": frame["reward_vector"].copy(),
            "vehicle": session.numbers,
            "agent_terminated": frame["agent_terminated"].astype(bool),
            **session.info(),
        }
        mean = float(reward[acted].mean(dtype=np.float64)) if acted.any() else 0.0
        return self._observation(), mean, False, session.over, info

    def _observation(self) -> dict[str, np.ndarray]:
        seen = {"observation": self.session.frame["observation"].copy(), "mask": self.session.mask.astype(np.int8)}
        if self.config.decide != STEP:
            seen["decides"] = self.session.decides.astype(np.int8)
        return seen


class EcoDrivingEgo(_View[np.ndarray]):
    """One controlled vehicle, the ego; all other CVs follow a given policy.

    An episode begins when a CV enters the region and ends when that CV leaves (terminated) or at the simulation's
    horizon (truncated). ``reset()`` does not restart the simulation: it goes on with ``others`` in control of every CV
    until the next CV enters, which becomes the ego (of several, the one with the lowest number), or begins the next
    simulation if the horizon comes first. ``reset(seed=...)`` and ``reset(options=...)`` always begin a simulation.

    - observation: ``[F]`` float32, columns in :attr:`observation_names`; zero after the ego has left.
    - action: ``[1]``, acceleration in m/s^2, clipped to [-4.5, 2.6]; NaN leaves it uncommanded and is counted. With
      ``config.action`` of ``speed`` a share of the speed limit, or several, one for each of ``action_parts``. Where
      ``config.decide`` is not ``step``, a step lasts until the ego decides again or has left. With
      ``config.lane_change`` a dictionary: this as ``acceleration``, and ``lane_change``, a number (0 right, 1 keep, 2
      left).
    - reward: the ego's.
    - info: ``vehicle`` (the ego's number in the simulation's demand), ``time_s``, and in steps ``reward_vector``
      ``[R]``; at the horizon ``metrics``.

    Args:
        others: maps a TensorDict with ``("agents", "observation")`` ``[A, F]`` and ``("agents", "mask")`` ``[A]`` to
            one with ``("agents", "action")`` ``[A, D]`` and, if it likes, ``("agents", "defer")`` ``[A]`` and
            ``("agents", "lane_change")`` ``[A]``: any policy that can be evaluated. It acts deterministically, and its
            input holds ``is_init`` ``[1]``, true in the first step of a simulation, and what it wrote in the step
            before, at the root or under ``"next"``. ``None``: they are uncommanded.
        contexts, config, render_mode, in_process, simulator: as for :class:`EcoDrivingJoint`.
    """

    def __init__(self, *args: Any, others: Policy | None = None, **options: Any) -> None:
        super().__init__(*args, **options)
        if others is not None and not callable(others):
            raise IzooError(f"others is a {type(others).__name__}; give a policy of TensorDicts, or None for SUMO.")
        self.others = others
        self.observation_space = spaces.Box(-np.inf, np.inf, (len(self.observation_names),), np.float32)
        self.action_space: Any = action_space(self.config, None)
        self._slot, self._vehicle = -1, -1
        self._kept: TensorDictBase | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Simulate until a CV enters, which is the ego; in the next simulation if none does.

        Raises:
            IzooError: none can ever enter.
        """
        super().reset(seed=seed)
        session = self.session
        self._slot = -1
        if seed is not None or options or session.over:
            session.begin(seed, options)
            self._kept = None  # the memory of ``others`` does not outlast a simulation
        empty = 0
        while not self._drive_to_ego():
            empty += 1
            if empty % WARN_AFTER == 0:
                gym.logger.warn(f"no controlled vehicle entered in {empty} simulations in a row; the search goes on.")
            session.begin_next_with_cvs()
            self._kept = None
        return self._observation(), {"vehicle": self._vehicle, **session.plan(), **session.info()}

    def _drive_to_ego(self) -> bool:
        """Simulate until a CV enters, which becomes the ego; return false if the simulation ends before."""
        session = self.session
        while not session.over:
            before = session.numbers
            session.step(self._commands())
            entered = session.numbers
            entered = np.where(np.isin(entered, before), -1, entered)
            if (entered >= 0).any() and not session.over:
                self._vehicle = int(entered[entered >= 0].min())
                self._slot = int(np.flatnonzero(entered == self._vehicle)[0])
                return True
        return False

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Simulate a step with the ego's action ``[D]``, or the dictionary described above."""
        session, frame, slot = self.session, self.session.frame, self._slot
        session.require_running()
        if slot < 0:
            raise IzooError("step() came after the ego's end; call reset(), which chooses the next one.")
        numbers, lane_change = read_action(self.config, action, None)
        reward, rewards, ended = 0.0, np.zeros_like(frame["reward_vector"][slot]), False
        while not ended:
            commands = self._commands()
            commands.action[slot], commands.defer[slot] = numbers[0], False
            commands.lane_change[slot] = lane_change[0]
            session.step(commands)
            terminated, truncated = bool(frame["agent_terminated"][slot]), bool(frame["agent_truncated"][slot])
            reward += float(frame["reward"][slot])
            rewards += frame["reward_vector"][slot]
            ended = terminated or truncated or bool(session.decides[slot])
        info = {"vehicle": self._vehicle, "reward_vector": rewards, **session.info()}
        observation = self._observation()
        if terminated or truncated:
            self._slot = -1
        return observation, reward, terminated, truncated, info

    def _observation(self) -> np.ndarray:
        return self.session.frame["observation"][self._slot].copy()

    def _commands(self) -> Commands:
        """Return the commands of ``others`` to every CV."""
        commands, count = self.session.commands(), self.config.num_agents
        if self.others is None:
            return commands
        import torch
        from tensordict import TensorDict
        from torchrl.envs.utils import ExplorationType, set_exploration_type

        frame, begins = self.session.frame, self._kept is None
        agents = {
            "observation": torch.from_numpy(frame["observation"].copy()),
            "mask": torch.from_numpy(self.session.mask),
        }
        if self.config.decide != STEP:
            agents |= {
                "decides": torch.from_numpy(self.session.decides),
                "number": torch.from_numpy(self.session.numbers),
            }
        seen = TensorDict({"agents": TensorDict(agents, [count]), "is_init": torch.tensor([begins])}, [])
        if self._kept is not None:
            seen.update(self._kept)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            result = self.others(seen)
        if result is None or ("agents", "action") not in result.keys(include_nested=True):
            raise IzooError("the policy 'others' wrote no ('agents', 'action'); it must return [A, D] actions.")
        chosen = {name: result.get(("agents", name), None) for name in Commands._fields}
        passing = [("agents", name) for name in (*agents, *Commands._fields)]
        kept, following = result.exclude("next"), result.get("next", None)
        self._kept = (kept if following is None else kept.update(following)).exclude("next", "is_init", *passing)
        commands.defer[:] = False
        for name, values in commands._asdict().items():
            if chosen[name] is not None:
                values[:] = chosen[name].reshape(values.shape).numpy()
        return commands


def joint_vector(num_envs: int = 1, **options: Any) -> ViewVector:
    """What ``gymnasium.make_vec("izoo.envs:izoo/EcoDriving-v0", num_envs)`` makes without a vectorization mode."""
    return ViewVector(functools.partial(EcoDrivingJoint, **options), num_envs)


def ego_vector(num_envs: int = 1, **options: Any) -> ViewVector:
    """What ``gymnasium.make_vec("izoo.envs:izoo/EcoDrivingEgo-v0", num_envs)`` makes without a vectorization mode."""
    return ViewVector(functools.partial(EcoDrivingEgo, **options), num_envs)
