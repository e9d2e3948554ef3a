"""Options of ``python -m izoo.benchmarks.planner``."""

from __future__ import annotations

from dataclasses import dataclass, field

from izoo.conf.built_in import CityContexts
from izoo.conf.context_choices import ContextsConfig
from izoo.envs.config import ACTION_LOW_MPS2, EnvConfig
from izoo.errors import IzooError, check_range
from izoo.files import expanded


@dataclass(frozen=True)
class PlannerConfig:
    """Options of the planner.

    Attributes:
        contexts: which contexts to play; every one is played at every adoption below.
        env: the environment; its reward and ``env.hold_s`` are the planner's own.
        num_contexts: how many contexts to draw; null: all of a finite set, and 16 of one without end.
        adoptions: shares of CVs.
        caps: advice that is tried for a CV, each a speed limit lower by that share; doing nothing is tried in any case.
        look_ahead_s: how far a trial goes.
        every_s: time between two trials; each is about one CV per intersection.
        brake_mps2: advice brakes no harder than this.
        seeds: episodes per context.
        seed: base of the episode seeds and of the drawn contexts.
        threads: of the twin; null: one per core.
        out: folder of the results, which an interrupted comparison goes on in; null: nothing is kept.
        verbose: print all figures of every driver.
    """

    contexts: ContextsConfig = field(default_factory=CityContexts)
    env: EnvConfig = field(default_factory=EnvConfig)
    num_contexts: int | None = None
    adoptions: tuple[float, ...] = (1 / 3, 1.0)
    caps: tuple[float, ...] = (0.2, 0.4, 0.55, 0.7, 0.8)
    look_ahead_s: float = 90.0
    every_s: float = 4.0
    brake_mps2: float = 1.5
    seeds: int = 1
    seed: int = 0
    threads: int | None = None
    out: str | None = None
    verbose: bool = False

    def __post_init__(self) -> None:
        if self.num_contexts is not None:
            check_range("num_contexts", self.num_contexts, 1, 10**7)
        check_range("seeds", self.seeds, 1, 10**6)
        check_range("seed", self.seed, 0, 2**31 - 1)
        for adoption in self.adoptions:
            check_range("adoptions", adoption, 1e-3, 1.0)
        for cap in self.caps:
            check_range("caps", cap, 1e-3, 1.0)
        if not (self.adoptions and self.caps):
            raise IzooError("adoptions and caps each need one entry or more.")
        self.env.require_accelerations("the planner")
        check_range("every_s", self.every_s, self.env.step_s, 60.0, "s")
        if abs(self.every_s / self.env.step_s - round(self.every_s / self.env.step_s)) > 1e-6:
            raise IzooError(f"every_s is {self.every_s:g}; give a whole multiple of env.step_s={self.env.step_s:g}.")
        check_range("look_ahead_s", self.look_ahead_s, self.every_s, 3600.0, "s")
        check_range("brake_mps2", self.brake_mps2, 0.1, -ACTION_LOW_MPS2, "m/s^2")
        if self.out is not None:
            object.__setattr__(self, "out", str(expanded(self.out).absolute()))
