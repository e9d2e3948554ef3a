"""Episodes of a policy in an environment: the one loop that plays them, and what was measured."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import cloudpickle
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from izoo.contexts.context import Context
from izoo.envs.config import EnvConfig
from izoo.envs.env import EcoDrivingBase, EcoDrivingEnv
from izoo.envs.mdp.frame import TEAM_REWARD
from izoo.envs.mdp.metric_sums import APPROACH_METRICS
from izoo.errors import IzooError
from izoo.results.schema import EPISODE_COLUMNS, Row, features, scored_approaches
from izoo.results.store import Key

Policy = Callable[[TensorDictBase], TensorDictBase]
Series = dict[str, NDArray[np.float32]]
INIT = "is_init"
"""Key ``[*B, 1]``, as of TorchRL's ``InitTracker``: whether an episode begins."""
VEHICLE_SPANS, VEHICLE_REWARD = "vehicle_spans", "vehicle_reward"
RECORDS = (TEAM_REWARD, VEHICLE_SPANS, VEHICLE_REWARD)
"""What can be recorded: ``[decisions]``, the reward's fleet part; ``[C, 3]``, of each CV its number in the demand, its
first decision and how many it was paid for; and what it was paid for each of them, one CV after the other."""
SIDE_BY_SIDE = 64
"""Episodes that are played at once on the twin."""
_SEED_MASK = 2**63 - 1


class Measured(NamedTuple):
    """What an episode came to.

    Attributes:
        rows: per scored approach ``approach``, features, sums and counts; without the columns of identity.
        series: what was recorded, by name (:data:`RECORDS`).
    """

    rows: list[Row]
    series: Series


@dataclass(frozen=True)
class Play:
    """An episode to play.

    Attributes:
        policy: ``human``, ``uncommanded``, or the name of one of the policies that are given.
        train_seed: which of its training seeds; 0 where nothing was trained.
        context: it is evaluated in; human drivers are alone in it.
        seed: of the episode.
    """

    policy: str
    train_seed: int
    context: Context
    seed: int

    @property
    def episode(self) -> tuple[str, int, str, int]:
        """What tells it from other plays."""
        return self.policy, self.train_seed, self.context.content_hash, self.seed

    def __str__(self) -> str:
        return f"policy {self.policy}, context {self.context.name}, seed {self.seed}"


@dataclass(frozen=True)
class Setup:
    """What all episodes of a rollout share.

    Attributes:
        policies: packed (:func:`izoo.results.policies.pack`), by key.
        config: the environment; it emits what is recorded.
        simulator: a name of :data:`izoo.envs.SIMULATORS`.
        workers: processes, or threads on the twin.
        record: of :data:`RECORDS`.
        side_by_side: episodes that a batch holds.
        surrogate: what computes CO2 in a batch (:class:`~izoo.envs.TwinEnv`).
    """

    policies: Mapping[Key, bytes]
    config: EnvConfig
    simulator: str = "sumo"
    workers: int = 2
    record: tuple[str, ...] = ()
    side_by_side: int = SIDE_BY_SIDE
    surrogate: str = "compiled"

    def policy(self, play: Play) -> Policy:
        """Return a fresh copy of what plays an episode."""
        own = (play.policy, play.train_seed)
        return cloudpickle.loads(self.policies[own if own in self.policies else play.policy])


class EpisodeFailed(RuntimeError):
    """An episode raised an exception or lost its process; the message names its policy, context and seed."""


def run_episode(
    env: EcoDrivingEnv,
    policy: Policy,
    context: Context,
    seed: int,
    record: Sequence[str] = (),
    beat: Callable[[], None] | None = None,
) -> Measured:
    """Play one episode.

    Stochastic policies act by their mode, and the default generators of torch, numpy and Python are seeded from the
    context and the seed, so that rows depend on neither the worker nor the order.

    Args:
        env: its frames hold the metrics, whether it emits them or not.
        policy: reads ``("agents", "observation")`` and ``("agents", "mask")``, writes ``("agents", "action")``.
        context, seed: what is played.
        record: of :data:`RECORDS`, which ``env`` emits.
        beat: called before every decision.
    """
    with _seeded((int(context.content_hash[:15], 16) ^ seed) & _SEED_MASK):
        (series,) = play(env, policy, env.reset(context=context, seed=seed), record, beat)
    return measured(env, context, series)


def play(
    env: EcoDrivingBase,
    policy: Policy,
    tensordict: TensorDictBase,
    record: Sequence[str] = (),
    beat: Callable[[], None] | None = None,
) -> list[Series]:
    """Step from a reset until all episodes have ended; return what was recorded, per environment.

    The policy finds ``is_init``, true in the first step alone, and what it has written before: at the root, or under
    ``"next"``, as TorchRL's recurrent modules do. One with a method ``bind`` is called as ``policy.bind(env)``.
    """
    act = policy.bind(env) if hasattr(policy, "bind") else policy
    begins = torch.ones(*env.batch_size, 1, dtype=torch.bool)
    goes_on = ~begins
    tensordict.set(INIT, begins)
    kept: dict[str, list[NDArray[np.float32]]] = {name: [] for name in _recorded(record)}
    lengths = np.zeros(env.batch_size.numel(), int)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        while True:
            lengths += env.frames["done"][:, 0] == 0
            if beat is not None:
                beat()
            result = act(tensordict)
            if result is None or ("agents", "action") not in result.keys(include_nested=True):
                raise IzooError(
                    "the policy wrote no ('agents', 'action'); it must return the TensorDict with that key."
                )
            written = result.get("next", None)
            if "number" in kept:
                kept["number"].append(env.frames["number"].copy())
            following = env.step_lean(result)
            for name in kept.keys() - {"number"}:
                kept[name].append(env.frames[name].copy())
            if following.get("done").all():
                break
            if written is not None:
                following.update(written.exclude(*following.keys(True, True)))
            following.set(INIT, goes_on)
            tensordict = step_mdp(result, exclude_action=True)
    whole = {name: np.stack(values, 1) for name, values in kept.items()}
    return [_series({name: values[k, :length] for name, values in whole.items()}) for k, length in enumerate(lengths)]


def _recorded(record: Sequence[str]) -> list[str]:
    """Return the arrays of a frame that are kept of every decision."""
    of_vehicles = ["number", "reward"] if VEHICLE_REWARD in record else []
    return [*(name for name in record if name == TEAM_REWARD), *of_vehicles]


def _series(kept: Mapping[str, NDArray[Any]]) -> Series:
    """Return what was recorded of an episode, from arrays ``[T, 1]`` and, of slots, ``[T, A]``."""
    series = {name: values[:, 0] for name, values in kept.items() if name == TEAM_REWARD}
    if "number" in kept:
        step, slot = np.nonzero(kept["number"] >= 0)
        number = kept["number"][step, slot]
        order = np.lexsort((step, number))
        found, first, count = np.unique(number[order], return_index=True, return_counts=True)
        series[VEHICLE_SPANS] = np.stack([found, step[order][first], count], 1).astype(np.float32)
        series[VEHICLE_REWARD] = kept["reward"][step, slot][order].astype(np.float32)
    return series


def measured(env: EcoDrivingBase, context: Context, series: Series, index: int = 0) -> Measured:
    """Return what the episode that has ended in the environment number ``index`` came to."""
    road = env.backend.scene(index).road
    approaches: list[list[float]] = env.frames["approach_metrics"][index].tolist()
    whole = dict(zip(EPISODE_COLUMNS, env.frames["episode_metrics"][index].tolist(), strict=True))
    rows = []
    for leg in scored_approaches(context):
        sums = dict(zip(APPROACH_METRICS, approaches[road.approaches.index(leg)], strict=True))
        rows.append({"approach": leg, **features(context, road, leg), **sums, **whole})
    return Measured(rows, series)


@dataclass
class Player:
    """An environment of one intersection and the packed policies; each episode gets a fresh copy of its policy.

    Attributes:
        beat: called before every decision, if given.
    """

    setup: Setup
    beat: Callable[[], None] | None = None
    _env: EcoDrivingEnv | None = field(default=None, init=False)

    def play(self, play: Play) -> Measured:
        """Play an episode."""
        if self._env is None:
            self._env = EcoDrivingEnv(config=self.setup.config, simulator=self.setup.simulator)
        policy = self.setup.policy(play)
        return run_episode(self._env, policy, play.context, play.seed, self.setup.record, self.beat)

    def close(self) -> None:
        """End the simulation."""
        if self._env is not None:
            self._env.close(raise_if_closed=False)


@contextlib.contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Seed what a policy may draw from by default, and leave it as it was found."""
    of_numpy, of_python = np.random.get_state(), random.getstate()  # noqa: NPY002 - what policies draw from
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            np.random.seed(seed % 2**32)  # noqa: NPY002
            random.seed(seed)
            yield
    finally:
        np.random.set_state(of_numpy)  # noqa: NPY002
        random.setstate(of_python)
