"""The value that a task is."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from izoo.algos.actions.action_modes import ActionConfig, DirectAction
from izoo.conf.context_choices import ContextsConfig
from izoo.contexts.context import Context
from izoo.contexts.source import ContextSource
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError

TEST_SEED = 241015221
"""Published constant: base of the episode seeds of tests, and of the test contexts that are drawn; never to change."""


@dataclass(frozen=True)
class Task:
    """What a policy is trained on, selected on and tested on, and in which environment.

    Attributes:
        name: how papers, tables and ``task=`` call it.
        about: what it asks, in a sentence.
        learns: what is known to learn there.
        train, validation, test: the contexts of each role: choices of ``contexts=`` with their options.
        env: the environment: what is observed and rewarded, the horizon, what a decision is (``action``,
            ``action_parts``) and how long it holds (``decide``, ``hold_s``).
        action: what the actions of learned policies stand for; fits ``env.action``.
        training: further options of ``izoo.train``, such as the simulator, by group and name.
        test_contexts: how many test contexts are played where there are more, drawn once for all; ``None``: all.
        test_episodes: episodes of each test context, with seeds from ``test_seed``.
        test_seed: base of the episode seeds of the test, and of the test contexts that are drawn.
    """

    name: str
    about: str
    learns: str
    train: ContextsConfig
    validation: ContextsConfig
    test: ContextsConfig
    env: EnvConfig = field(default_factory=EnvConfig)
    action: ActionConfig = field(default_factory=DirectAction)
    training: Mapping[str, Any] = field(default_factory=dict)
    test_contexts: int | None = 96
    test_episodes: int = 1
    test_seed: int = TEST_SEED

    def test_set(self, most: int | None = None) -> list[Context]:
        """Return the contexts that a test plays, in their order; ``most``: no more than so many of them."""
        counts = [count for count in (self.test_contexts, most) if count is not None]
        return limited(self.test.build(), min(counts, default=None), self.test_seed)

    def changed(
        self,
        adoption: float | None = None,
        cv_vehicle: str | None = None,
        path: str | None = None,
    ) -> Task:
        """Return the task under other conditions; ``None`` leaves each as it is.

        Args:
            adoption: share of controlled vehicles, 0 to 1; becomes part of the name.
            cv_vehicle: ``paper`` or ``human`` parameters of controlled vehicles; becomes part of the name.
            path: folder of the measured intersections.
        """
        values = {"adoption": adoption, "cv_vehicle": cv_vehicle, "path": path}
        values = {key: value for key, value in values.items() if value is not None}
        found = self
        for role in ("train", "validation", "test"):
            contexts = getattr(self, role)
            fitting = {key: value for key, value in values.items() if hasattr(contexts, key)}
            found = dataclasses.replace(found, **{role: dataclasses.replace(contexts, **fitting)})
        if path is not None and found == self:
            raise IzooError(f"task={self.name} reads no folder; leave contexts.path out.")
        said = "".join(f", {key}={values[key]:.3g}" for key in ("adoption",) if key in values)
        said += f", cv_vehicle={cv_vehicle}" if cv_vehicle is not None else ""
        return dataclasses.replace(found, name=self.name + said)


def limited(source: ContextSource, count: int | None, seed: int = TEST_SEED) -> list[Context]:
    """Return at most ``count`` contexts of a source; of a finite one in its order, a larger count has every smaller.

    Args:
        source: a finite set, or a distribution, which is drawn from.
        count: ``None``: all of a finite set.
        seed: of the draw.
    """
    if not hasattr(source, "__len__"):
        if count is None:
            raise IzooError("a distribution has no last context; say how many to draw.")
        generator = np.random.default_rng(seed)
        return [source.sample(generator) for _ in range(count)]
    contexts = cast(Sequence[Context], source)
    if count is None or count >= len(contexts):
        return [contexts[k] for k in range(len(contexts))]
    chosen = np.random.default_rng(seed).permutation(len(contexts))[:count]
    return [contexts[int(k)] for k in np.sort(chosen)]
