"""How much is there to gain? A planner that knows the future looks for advice by trial, on branches of the twin.

It could not drive anywhere else: before it advises a CV, it plays what would follow from each advice, with the very
vehicles that will come. What it finds is a lower bound of what could be gained, since it changes the advice of one CV
at a time. A campaign plays it as an entry (:class:`izoo.benchmarks.campaign.experiment.Entry`).
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from tensordict import TensorDictBase
from torch import Tensor

from izoo.algos.actions.action_wrappers import SpeedCap
from izoo.envs import RewardConfig, TwinEnv
from izoo.envs.config import ACTION_LOW_MPS2, EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.errors import IzooError, check_range
from izoo.metrics.pairing import PLANNER
from izoo.options import CheckedOptions
from izoo.results.rollout import evaluated

AT_ONCE = 16
"""Intersections that are played side by side."""
SAY_EVERY = 50
"""Decisions between two lines that say how far the planner is."""
WAY_G_PER_M = 0.3
"""About what a vehicle burns per metre, with delay. A trial is paid this for the way that vehicles have driven: at its
end more still lies ahead of those that were slowed down, and otherwise putting off would pay."""
LEAST_GAIN = 1e-3
"""Advice is changed for no less, in units of what human driving burns in a step: rounding is no reason."""


@dataclass(frozen=True)
class PlannerConfig(CheckedOptions):
    """Options of the planner.

    Attributes:
        env: the environment; its reward and ``env.hold_s`` are the planner's own.
        caps: advice that is tried for a CV, each a speed limit lower by that share; doing nothing is tried in any case.
        look_ahead_s: how far a trial goes.
        every_s: time between two trials; each is about one CV per intersection.
        brake_mps2: advice brakes no harder than this.
    """

    env: EnvConfig = field(default_factory=EnvConfig)
    caps: tuple[float, ...] = (0.2, 0.4, 0.55, 0.7, 0.8)
    look_ahead_s: float = 90.0
    every_s: float = 4.0
    brake_mps2: float = 1.5
    ranges = (("brake_mps2", 0.1, -ACTION_LOW_MPS2, "m/s^2"),)

    def __post_init__(self) -> None:
        super().__post_init__()
        for share in self.caps:
            check_range("caps", share, 1e-3, 1.0)
        if not self.caps:
            raise IzooError("caps needs one entry or more.")
        self.env.require_accelerations("the planner")
        check_range("every_s", self.every_s, self.env.step_s, 60.0, "s")
        if abs(self.every_s / self.env.step_s - round(self.every_s / self.env.step_s)) > 1e-6:
            raise IzooError(f"every_s is {self.every_s:g}; give a whole multiple of env.step_s={self.env.step_s:g}.")
        check_range("look_ahead_s", self.look_ahead_s, self.every_s, 3600.0, "s")

    @property
    def source(self) -> str:
        """What makes it the planner that it is; rows of another one are not kept beside its own."""
        own = {name: getattr(self, name) for name in ("caps", "look_ahead_s", "every_s", "brake_mps2")}
        return f"planner {own}"


def settings(config: PlannerConfig) -> EnvConfig:
    """Return the environment: decisions as long as between two trials, rewarded as a team, episodes played out."""
    reward = dataclasses.replace(RewardConfig.fuel_team(), speed=WAY_G_PER_M * config.env.step_s)
    return evaluated(dataclasses.replace(config.env, hold_s=config.every_s, reward=reward, emit=("team_reward",)))


@dataclass(frozen=True)
class Planning:
    """The planner as a policy: :func:`izoo.results.rollout.rollout` binds it to the world that it branches."""

    config: PlannerConfig

    def bind(self, world: TwinEnv) -> Callable[[TensorDictBase], TensorDictBase]:
        """Return what acts in ``world``, whose episodes have just begun."""
        return Planner(world, self.config).act

    def __call__(self, state: TensorDictBase) -> TensorDictBase:
        raise NotImplementedError("the planner acts once it is bound to a world")


class Planner:
    """Advises CVs by trial: one CV per intersection at a time, the one that has waited longest for it.

    Advice holds until the next trial about the same CV, or until it has crossed the stop line. Branches are made of the
    ``world``, which is at the beginning of its episodes.
    """

    def __init__(self, world: TwinEnv, config: PlannerConfig) -> None:
        self.world, self.config = world, config
        self.cap = SpeedCap(world.config, config.brake_mps2)
        self.approaching = observation_names(world.config).index("location_approaching")
        self.candidates = torch.tensor([0.0, 0.0, *config.caps])  # as it is, nothing, or one of the caps
        self.branches = world.branch(len(self.candidates))
        shape = (world.num_envs, world.config.num_agents)
        self.advice, self.asked = torch.zeros(shape), torch.full(shape, -1.0)
        self.decisions = 0

    def act(self, state: TensorDictBase) -> TensorDictBase:
        """Look for better advice for one CV of each environment, and write all commands."""
        self._forget(self.advice, state)
        mask = state.get(("agents", "mask"))
        self.asked[~mask] = -1.0
        here = mask & (state.get(("agents", "observation"))[..., self.approaching] > 0.5)
        waiting = torch.where(here, self.decisions - self.asked, torch.full_like(self.asked, -1.0))
        longest, slot = waiting.max(-1)
        if bool((longest >= 0).any()):
            rows = torch.arange(len(slot))
            tried = self.candidates.repeat(len(slot), 1)
            tried[:, 0] = self.advice[rows, slot]
            worth = self._tried(slot, tried)
            best = worth.argmax(-1)
            better = (longest >= 0) & (worth[rows, best] > worth[:, 0] + LEAST_GAIN)
            self.advice[rows[better], slot[better]] = tried[rows, best][better]
            self.asked[rows, slot] = float(self.decisions)
        self.decisions += 1
        if self.decisions % SAY_EVERY == 0:
            print(f"{PLANNER}: {self.decisions} decisions in each episode", file=sys.stderr, flush=True)
        return self._command(state, self.advice)

    def _tried(self, slot: Tensor, tried: Tensor) -> Tensor:
        """Return the team's rewards of what follows from advising ``tried [N, K]`` in the slots ``[N]``, ``[N, K]``."""
        count = tried.shape[1]
        self.world.branch_into(self.branches)
        advice = self.advice.repeat_interleave(count, 0)
        advice[torch.arange(len(advice)), slot.repeat_interleave(count)] = tried.reshape(-1)
        now, worth = self.branches.present(), torch.zeros(len(advice))
        for _ in range(max(round(self.config.look_ahead_s / self.config.every_s), 1)):
            self._forget(advice, now)
            following = self.branches.step_lean(self._command(now, advice))
            worth += following.get("team_reward").squeeze(-1)
            if following.get("done").all():
                break
            now = following.exclude(("agents", "reward"))
        return worth.view(-1, count)

    def _forget(self, advice: Tensor, state: TensorDictBase) -> None:
        """Forget the advice of vehicles that have crossed the stop line, and of empty slots."""
        here = state.get(("agents", "mask")) & (state.get(("agents", "observation"))[..., self.approaching] > 0.5)
        advice[~here] = 0.0

    def _command(self, state: TensorDictBase, advice: Tensor) -> TensorDictBase:
        seen = self.cap.look(state.get(("agents", "observation")), state.get(("agents", "mask")))
        accel, defer = self.cap.command(seen, advice)
        state.set(("agents", "action"), accel.unsqueeze(-1))
        return state.set(("agents", "defer"), defer)
