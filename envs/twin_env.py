"""Many intersections on the twin as one TorchRL environment."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import hmac
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from izoo import __version__
from izoo.contexts.source import Schedule
from izoo.cores import usable_cores
from izoo.envs.backend import Play
from izoo.envs.config import EnvConfig
from izoo.envs.env import Contexts
from izoo.envs.mdp.columns import Vehicle
from izoo.envs.mdp.metric_sums import APPROACH_METRICS
from izoo.envs.model_version import MODEL_VERSION
from izoo.envs.side_by_side import SideBySideEnv
from izoo.envs.twin.backend import TwinBackend
from izoo.envs.twin.runtime.layout import STATE
from izoo.errors import IzooError, check_whole
from izoo.user_key import own_key

_ENTRIES = ("settings", "plays", "episodes", "next_episodes", "packed")
"""What a saved state holds besides its mark; all but the first are one per environment."""
_MARK = "mark"
_LAYOUT = repr((STATE.fields, Vehicle.descr))
"""In which order a state lies in memory: another one may be as long."""
_OF_PROCESSES = ("recycle_episodes", "watchdog_s", "gui")
"""Settings that change no episode."""


def _settings(config: EnvConfig) -> dict[str, Any]:
    """Return the settings that a state depends on, as numbers, texts and lists by name."""
    fields = dataclasses.asdict(config)
    reward = fields.pop("reward")
    fields |= {f"reward.{name}": value for name, value in reward.items()}
    named = {name: list(value) if isinstance(value, tuple) else value for name, value in fields.items()}
    return {name: value for name, value in named.items() if name not in _OF_PROCESSES}


def _mark_of(state: Mapping[str, Any]) -> str:
    """Return what only this user can have added to a state: compiled code takes the state as it is."""
    plain = [__version__, MODEL_VERSION, APPROACH_METRICS, _LAYOUT, *(state[name] for name in _ENTRIES[:-1])]
    packed = [hashlib.sha256(bytes(part.numpy())).hexdigest() for part in state["packed"]]
    return hmac.new(own_key(), json.dumps([*plain, *packed]).encode(), "sha256").hexdigest()


def is_own_state(state: Mapping[str, Any]) -> bool:
    """Whether a state is as this user, and this version of izoo, saved it."""
    try:
        return hmac.compare_digest(str(state[_MARK]).encode(), _mark_of(state).encode())
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError):  # it holds other things
        return False


def _planned(schedule: Schedule, number: int) -> Play:
    return Play(*schedule(number), number)


class TwinEnv(SideBySideEnv):
    """``N`` intersections on the twin, all in this process; batch size ``[N]``, and else what ``SumoParallelEnv`` is.

    A context and a seed give the same trajectory whatever the number of environments and threads, and whatever was
    played before. Where episodes are played out (``config.drain_s``) each environment ends by itself; until all have
    ended, those that have may be stepped on, and stay as they are: done, with nothing in their slots. While episodes
    run, another thread prepares those that come next.

    Args:
        num_envs: ``N``.
        contexts, options: as for :class:`~izoo.envs.side_by_side.SideBySideEnv`.
        threads: how many threads share the environments out among them; by default one per core that is usable.
        surrogate: what computes CO2: ``torch``, the module :class:`~izoo.emissions.moves.MovesSurrogate` in one call
            for all vehicles; ``cuda``, the same on a GPU; or ``compiled``, the same function without torch.
    """

    backend: TwinBackend
    taken_by_backend = True

    def __init__(
        self,
        num_envs: int = 64,
        contexts: Contexts | None = None,
        *,
        threads: int | None = None,
        surrogate: str = "torch",
        **options: Any,
    ) -> None:
        threads = usable_cores() if threads is None else threads
        super().__init__(num_envs, contexts, threads=threads, surrogate=surrogate, **options)
        self.backend.played = self.reader.take

    def make_backend(self, config: EnvConfig, num_envs: int, **options: Any) -> TwinBackend:
        return TwinBackend(config, num_envs, **options)

    def _set_seed(self, seed: int | None) -> None:
        super()._set_seed(seed)
        # An episode that was prepared ahead has the number of another one now.
        self.backend.forget_ahead()

    def _reset(self, tensordict: TensorDictBase | None = None, **options: Any) -> TensorDictBase:
        frame = super()._reset(tensordict, **options)
        self._look_ahead()
        return frame

    def share_out(self, task: Callable[[slice], object]) -> None:
        """Call ``task`` with each thread's share of the environments, all threads side by side."""
        self.backend.share_out(task)

    def _look_ahead(self) -> None:
        """Let the next episode of every environment be prepared."""
        schedule = self.schedule
        for index in self.backend.unexpected(self._next_episode):
            number = int(self._next_episode[index])
            self.backend.expect(index, number, functools.partial(_planned, schedule, number))

    def advance(self, decisions: Sequence[int]) -> TensorDict:
        """Play on in each environment for so many decisions, every CV left to its driver; return the state to act on.

        So environments that began together are each in another phase of their episodes.

        Args:
            decisions: ``[N]``, fewer than an episode has left until its horizon.

        Raises:
            IzooError: an episode would come to its horizon.
        """
        self.require_started("advance")
        with self.used_by_one_thread():
            self.backend.advance(decisions)
            return self._frame()

    def present(self) -> TensorDict:
        """Return the present state of all environments, to act on: what the last reset or step led to."""
        self.require_started("present")
        return self._frame()

    def state_dict(self, *_: Any, **__: Any) -> dict[str, Any]:
        """Return the exact state of all environments as tensors and numbers: what is loaded goes on bit for bit.

        With it goes what it is the state of: the settings, and the context (by its hash) and the seed of each episode.
        """
        self.require_started("state_dict")
        plays = self.backend.plays()
        state = {
            "settings": _settings(self.config),
            "plays": [[play.context.content_hash, play.seed] for play in plays],
            "episodes": [play.number for play in plays],
            "next_episodes": self._next_episode.tolist(),
            "packed": [torch.from_numpy(packed.copy()) for packed in self.backend.pack()],
        }
        return {**state, _MARK: _mark_of(state)}

    def load_state_dict(self, state: Mapping[str, Any], *_: Any, **__: Any) -> None:  # type: ignore[override]
        """Go on from what :meth:`state_dict` returned, on the same schedule; :meth:`present` is where it stood.

        After ``set_seed`` the schedule is another one; :meth:`branch` keeps a state whatever the schedule has become.

        Raises:
            IzooError: another number of environments, another schedule, other settings or another user saved it; the
                environments stay as they are. After a state of another layout they need a reset.
        """
        self.backend.unpack(self._plays_of(state), [packed.numpy() for packed in state["packed"]])
        self._next_episode[:] = state["next_episodes"]
        self._look_ahead()

    def _plays_of(self, state: Mapping[str, Any]) -> dict[int, Play]:
        """Return the episodes of a state.

        Raises:
            IzooError: it is no state, or not of these settings, this schedule and as many environments.
        """
        self.require_open()
        missing = [name for name in _ENTRIES if name not in state]
        if missing:
            raise IzooError(f"the saved state has no {', '.join(missing)}; give what state_dict() returned.")
        counts = {len(state[name]) for name in _ENTRIES[1:]}
        if counts != {self.num_envs}:
            raise IzooError(
                f"the saved state is that of {' or '.join(map(str, sorted(counts)))} environments, and this has "
                f"{self.num_envs}; make one with as many."
            )
        self._check_settings(state["settings"])
        plays = {index: Play(*self.schedule(number), number) for index, number in enumerate(state["episodes"])}
        for play, (digest, seed) in zip(plays.values(), state["plays"], strict=True):
            if (play.context.content_hash, play.seed) != (digest, seed):
                raise IzooError(
                    f"the saved state does not fit episode {play.number} of the schedule, which is seed {play.seed} of "
                    f"{play.context.name} ({play.context.content_hash[:8]}): it is that of seed {seed} of a context "
                    f"with the hash {digest[:8]}. Make an environment with the contexts and the seed that saved it."
                )
        if not is_own_state(state):
            raise IzooError(
                "the saved state is damaged, or another user or version of izoo saved it, and it is not taken "
                "unchecked; begin anew with reset()."
            )
        return plays

    def _check_settings(self, there: Mapping[str, Any]) -> None:
        """Raise :class:`IzooError` where a state is that of other settings."""
        here = _settings(self.config)
        other = [name for name in {**here, **there} if here.get(name) != there.get(name)]
        if other:
            pairs = ", ".join(f"env.{name} {there.get(name)!r} (here {here.get(name)!r})" for name in other)
            raise IzooError(f"the saved state is that of other settings: {pairs}; make an environment with the same.")

    def branch(self, n: int) -> TwinEnv:
        """Return ``n`` copies of every environment as they are now, ``[N * n]``: those of the first one come first.

        What a copy plays after its present episode is of its own.
        """
        check_whole("n", n, 1, 65536 // self.num_envs)
        self.require_started("branch")
        copies = TwinEnv(
            self.num_envs * n,
            self.schedule,
            config=self.config,
            threads=self.backend.wanted_threads,
            surrogate=self.backend.surrogate,
            shard=0,
        )
        copies._next_episode[:] = self._next_episode.max() + np.arange(copies.num_envs)
        self.branch_into(copies)
        return copies

    def branch_into(self, copies: TwinEnv) -> None:
        """Bring copies that :meth:`branch` made to where these environments are now, whatever they have played.

        Faster than new ones. Which episodes the copies play next does not change.

        Raises:
            IzooError: another number of copies for each environment, or other settings.
        """
        self.require_started("branch_into")
        copies.require_open()
        n, rest = divmod(copies.num_envs, self.num_envs)
        if rest:
            raise IzooError(
                f"{copies.num_envs} environments are no copies of {self.num_envs}; take those that branch(n) returned."
            )
        copies._check_settings(_settings(self.config))
        plays = [play for play in self.backend.plays() for _ in range(n)]
        copies.backend.unpack(dict(enumerate(plays)), [packed for packed in self.backend.pack() for _ in range(n)])
        copies._look_ahead()
