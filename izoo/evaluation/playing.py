"""Episodes of a policy in contexts: the lean loop that evaluation runs, and the rows it yields."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from izoo.contexts.context import Context
from izoo.envs.env import EcoDrivingBase, EcoDrivingEnv
from izoo.errors import IzooError
from izoo.evaluation.processes import Rows
from izoo.evaluation.table import EPISODE_COLUMNS, features, identity, scored_approaches
from izoo.metrics.definitions import APPROACH_METRICS, DEMAND, EPISODE_METRICS
from izoo.networks.road import RoadNet

if TYPE_CHECKING:
    from izoo.envs.twin_env import TwinEnv

Policy = Callable[[TensorDictBase], TensorDictBase]
INIT = "is_init"
"""Key ``[*B, 1]``, as of TorchRL's ``InitTracker``: whether an episode begins."""
_SEED_MASK = 2**63 - 1


def run_episode(env: EcoDrivingEnv, policy: Policy, name: str, context: Context, seed: int) -> Rows:
    """Play one episode and return a row per scored approach (:mod:`izoo.evaluation.table`).

    Stochastic policies act by their mode, and the default generators of torch, numpy and Python are seeded from the
    context and the seed, so that rows depend on neither the worker nor the order.

    Args:
        env: its frames hold the metrics, whether it emits them or not.
        policy: reads ``("agents", "observation")`` and ``("agents", "mask")``, writes ``("agents", "action")``.
        name: the policy's name in the rows.
    """
    drawn_from = (int(context.content_hash[:15], 16) ^ seed) & _SEED_MASK
    with _seeded(drawn_from), set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        play(env, policy, env.reset(context=context, seed=seed))
    return _rows(env.road, env.reader.metrics(), name, context, seed)


def run_together(env: TwinEnv, policy: Policy, name: str, plays: Sequence[tuple[Context, int]]) -> list[Rows]:
    """Play an episode in each environment, and return the rows of each.

    They are those of :func:`run_episode` where a policy does to every row of a batch what it does to it alone, and
    draws no random numbers.

    Args:
        env: as many environments as ``plays``, on a schedule that begins with these.
        policy, name: as for :func:`run_episode`.
        plays: context and seed of each environment.
    """
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        play(env, policy, env.reset())
    metrics = env.reader.metrics()
    return [
        _rows(env.scene(index).road, metrics[index], name, context, seed) for index, (context, seed) in enumerate(plays)
    ]


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


def play(env: EcoDrivingBase, policy: Policy, tensordict: TensorDictBase) -> None:
    """Step from a reset to the end of the episode.

    The policy finds ``is_init``, true in the first step alone, and what it has written before: at the root, or under
    ``"next"``, as TorchRL's recurrent modules do.
    """
    begins = torch.ones(*env.batch_size, 1, dtype=torch.bool)
    goes_on = ~begins
    tensordict.set(INIT, begins)
    while True:
        result = policy(tensordict)
        if result is None or ("agents", "action") not in result.keys(include_nested=True):
            raise IzooError("the policy wrote no ('agents', 'action'); it must return the TensorDict with that key.")
        kept = result.get("next", None)
        following = env.step_lean(result)
        if following.get("done").any():
            return
        if kept is not None:
            following.update(kept.exclude(*following.keys(True, True)))
        following.set(INIT, goes_on)
        tensordict = step_mdp(result, exclude_action=True)


def _rows(road: RoadNet, metrics: TensorDictBase, name: str, context: Context, seed: int) -> Rows:
    approach, episode = metrics.get("approach"), metrics.get("episode")
    sums = {metric: approach.get(metric).tolist() for metric in APPROACH_METRICS}
    whole = {
        column: float(episode.get(metric)) for column, metric in zip(EPISODE_COLUMNS, EPISODE_METRICS, strict=True)
    }
    rows = []
    for leg in scored_approaches(context):
        p = road.approaches.index(leg)
        values = {metric: column[p] for metric, column in sums.items()}
        check_closed(values, f"{name} in {context.name}, approach {leg}, seed {seed}")
        rows.append({**identity(name, context, seed, leg), **features(context, road, leg), **values, **whole})
    return rows


def check_closed(sums: Mapping[str, float], episode: str) -> None:
    """Check that every vehicle that was due is accounted for.

    ``due = dropped + waiting + outside + early + entered`` and ``entered = crossed + unfinished``, of an approach.

    Args:
        sums: by the names of :data:`izoo.metrics.definitions.APPROACH_METRICS`.
        episode: in words.

    Raises:
        IzooError: vehicles are missing, or counted twice.
    """
    for whole, parts in (("due", (*DEMAND, "early")), ("entered", ("crossed", "unfinished"))):
        total = sum(sums[part] for part in parts)
        if total != sums[whole]:
            counted = ", ".join(f"{part} {sums[part]:g}" for part in parts)
            raise IzooError(
                f"the demand does not close ({episode}): {sums[whole]:g} vehicles {whole}, but {counted} make "
                f"{total:g}. The simulator lost count of vehicles; please report it."
            )
