"""Options of ``python -m izoo.evaluate``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

from izoo.algos.learners.registry import DRIVER_NAMES, cap_share
from izoo.conf.built_in import CityContexts
from izoo.conf.context_choices import ContextsConfig
from izoo.envs import REFERENCE, simulator_of
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError, check_choice
from izoo.files import expanded, make_absolute
from izoo.options import CheckedOptions

DRAIN_S = 600.0
"""How long evaluated episodes are played out after their horizon, at most."""
EPISODE_RANGES = (("num_contexts", 1, 10**7), ("seeds", 1, 10**6), ("seed", 0, 2**31 - 1), ("num_workers", 0, 1024))


@dataclass(frozen=True)
class EvaluateConfig(CheckedOptions):
    """Options of an evaluation.

    Attributes:
        task: a task of :mod:`izoo.tasks`: its test contexts, environment and episode seeds, where these are not given;
            null: none, or, with a run, the one that it was trained for.
        run: folder of a training run, or one of its checkpoint files.
        checkpoint: of a run's folder: ``last``, ``best`` (by validation), or the number of frames it was saved after.
        policy: instead of a run: a driver (``human``, ``uncommanded``, ``constant``, ``constant_2.0``, ``random``,
            ``glide``, ``cap_0.6``), a trained policy that ships (``zoo:NAME``; ``python -m izoo.zoo list``), one that
            ``python -m izoo.zoo export`` wrote (``FILE.pt``), ``module:function``, or the folder of a run, of which
            ``run`` would bring the contexts, too.
        name: what tables call it; runs of several training seeds that have the same name, and the same ``out``, are one
            entry. null: the run's folder, or the policy.
        contexts: which contexts to evaluate in; where a run is given, those of its task's test, or its own without a
            task, unless this option is.
        env: the environment; where a run is given, its own but for the ``env`` options that are given, and but for the
            length of an episode and its warm-up, which training may shorten and which are full here unless given.
            Episodes are played out after their horizon for ``env.drain_s`` at most.
        num_contexts: how many contexts to draw; null: all of a finite set, and 16 of one without end.
        seeds: paired episodes per context.
        seed: base of the episode seeds and of the drawn contexts.
        out: folder of the results; an evaluation that was interrupted goes on there. null: a folder named after the
            options, in ``evaluations`` of the run's folder or of the current one.
        simulator: what plays the episodes: ``sumo``, which is what counts, or ``twin``, its compiled copy.
        num_workers: worker processes, each with one simulator; with ``batch``, threads.
        executor: ``processes`` of this machine, or those of a ``ray`` cluster (the one that RAY_ADDRESS names, or else
            one on this machine). ``batch``: episodes side by side on the twin, for policies that act on a batch as on
            each of its rows, and draw no random numbers. null: ``batch`` on the twin, and otherwise ``processes``.
        cache: folder of the cached episodes of baselines; null: the user's cache folder.
        verbose: print every table; ``-v`` is short for it.
    """

    task: str | None = None
    run: str | None = None
    checkpoint: str = "last"
    policy: str | None = None
    name: str | None = None
    contexts: ContextsConfig = field(default_factory=CityContexts)
    env: EnvConfig = field(default_factory=lambda: EnvConfig(drain_s=DRAIN_S))
    num_contexts: int | None = 16
    seeds: int = 3
    seed: int = 0
    out: str | None = None
    simulator: str = REFERENCE
    num_workers: int = 2
    executor: Literal["processes", "batch", "ray"] | None = None
    cache: str | None = None
    verbose: bool = False
    role: ClassVar[str] = "test"
    """Whose contexts of a task are meant."""
    ranges = EPISODE_RANGES

    def __post_init__(self) -> None:
        super().__post_init__()
        simulator_of(self.simulator)
        if self.run is None and self.checkpoint != "last":
            raise IzooError(
                f"checkpoint={self.checkpoint} chooses among those of a run's folder, but run is not given; give "
                "run=RUN_DIR, or leave checkpoint out."
            )
        if self.policy is not None:
            check_policy("policy", self.policy)
        make_absolute(self, "run", "out", "cache")


def check_policy(what: str, policy: str) -> None:
    """Raise :class:`IzooError` unless a policy is a driver's name or a path that exists, or looks like ``FILE.pt`` or
    ``module:function``.
    """
    looks_right = ":" in policy or Path(policy).suffix == ".pt" or cap_share(policy) is not None
    if not looks_right and not expanded(policy).exists():
        check_choice(what, policy, [*DRIVER_NAMES, "cap_SHARE", "zoo:NAME", "FILE.pt", "module:function"])
