"""Options of ``python -m izoo.benchmarks.twin``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from izoo.conf.built_in import CityContexts
from izoo.conf.context_choices import ContextsConfig
from izoo.conf.evaluate_options import check_episodes, check_policy
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError, check_choice, check_range, check_types
from izoo.files import expanded
from izoo.metrics.pairing import HUMAN
from izoo.zoo import shelf


@dataclass(frozen=True)
class LadderConfig:
    """Options of the comparison of the twin with SUMO.

    Attributes:
        contexts: which contexts to play; every one is played at every adoption and with every demand below.
        env: the environment.
        num_contexts: how many contexts to draw; null: all of a finite set, and 16 of one without end.
        adoptions: shares of CVs; human driving is played beside them in any case.
        demand: ``given`` as the contexts say, ``all`` with vehicles from all approaches.
        policies: drivers, ``zoo:NAME``, ``FILE.pt``, or ``module:function``; everybody is played in the environment of
            the policy from the zoo, if there is one.
        exact: of which of them to compare every vehicle in every step, in the first episode of each context.
        seeds: episodes per context.
        late: how often SUMO plays everything again, with another vehicle of every approach a step late. How far it is
            from itself then is what differences are judged against.
        seed: base of the episode seeds and of the drawn contexts.
        num_workers: worker processes that play SUMO.
        out: folder of the results; a comparison that was interrupted goes on there.
        cache: folder of the cached episodes of human and uncommanded driving; null: the user's cache folder.
        verbose: print every rung, not only how far apart policies are.
    """

    contexts: ContextsConfig = field(default_factory=CityContexts)
    env: EnvConfig = field(default_factory=EnvConfig)
    num_contexts: int | None = None
    adoptions: tuple[float, ...] = (1 / 3, 1.0)
    demand: tuple[Literal["given", "all"], ...] = ("given", "all")
    policies: tuple[str, ...] = ("uncommanded", "glide", "random")
    exact: tuple[str, ...] = ("uncommanded", "glide")
    seeds: int = 3
    late: int = 1
    seed: int = 0
    num_workers: int = 2
    out: str = "twin-ladder"
    cache: str | None = None
    verbose: bool = False

    def __post_init__(self) -> None:
        check_types("", self)
        check_episodes(self)
        for adoption in self.adoptions:
            check_range("adoptions", adoption, 0.0, 1.0)
        check_range("late", self.late, 0, 1000)
        if self.late and self.env.late_vehicle:
            raise IzooError("late=0 or env.late_vehicle=0: the comparison sets env.late_vehicle itself.")
        for demand in self.demand:
            check_choice("demand", demand, ("given", "all"))
        for name in ("policies", "exact"):
            for policy in getattr(self, name):
                if policy == HUMAN:
                    raise IzooError(f"{name} holds 'human', which is played in any case; leave it out.")
                check_policy(name, policy)
            object.__setattr__(self, name, tuple(map(shelf.absolute, getattr(self, name))))
        if not (self.adoptions and self.demand and self.policies):
            raise IzooError("adoptions, demand and policies each need one entry or more.")
        for name in ("out", "cache"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, str(expanded(value).absolute()))
