"""Which options of a training run go together."""

from __future__ import annotations

from izoo.conf.train_options import TrainConfig
from izoo.envs import simulator_of
from izoo.envs.config import SPEED, STEP
from izoo.errors import IzooError
from izoo.gpu import check_gpu
from izoo.results import ray_cluster


def check_options(config: TrainConfig) -> None:
    """Raise :class:`IzooError` where options of a run do not go together, or need what is not installed here."""
    if config.env.lane_change:
        raise IzooError(
            "env.lane_change=true asks the policy for lane changes as well, but izoo's learners command accelerations "
            "alone; leave it out."
        )
    if config.env.drain_s:
        raise IzooError(
            f"env.drain_s is {config.env.drain_s:g}, but training episodes end at their horizon; leave it at 0. "
            "Evaluations play their episodes out by themselves."
        )
    simulator = simulator_of(config.simulator)
    simulator.check_settings(config.env)
    if simulator.batched and config.twin.surrogate == "cuda":
        check_gpu("twin.surrogate", "torch")
    _check_decisions(config)
    policies, envs = config.algo.candidates, config.environments
    if policies > 1 and (not simulator.batched or envs % policies or config.env.reward.eta != 1.0):
        raise IzooError(
            f"algo={config.algo.name} lets {policies} policies play the same episodes side by side and compares "
            f"their teams' rewards, but simulator is {config.simulator}, num_envs {envs} and env.reward.eta "
            f"{config.env.reward.eta:g}; choose simulator=twin, a multiple of {policies} for num_envs, and "
            "env.reward=fuel_team or env.reward.eta=1."
        )
    if config.collector.name == "ray":
        ray_cluster.connect()


def _check_decisions(config: TrainConfig) -> None:
    """Raise :class:`IzooError` where the options of a run need decisions, or a simulator, that it does not have."""
    algo, decide = config.algo, config.env.decide
    variate = getattr(algo, "control_variate", "none")
    simulator = simulator_of(config.simulator)
    if variate != "none" and not simulator.batched:
        raise IzooError(
            f"algo.control_variate={variate} plays every training episode a second time, uncommanded, which "
            f"{simulator.label} does not during training; choose simulator=twin, or algo.control_variate=none."
        )
    if algo.candidates > 1 and config.env.action == SPEED:
        raise IzooError(
            f"algo={algo.name} compares policies that command accelerations or give advice, but action is "
            f"{config.action.name}; choose action=direct or advise, and env.action=acceleration."
        )
    if decide == STEP:
        return
    by_step = {
        f"algo={algo.name}": algo.candidates > 1,
        f"action={config.action.name}": config.action.name in ("advise", "residual"),
        "algo.credit=team": getattr(algo, "credit", "agent") == "team",
        "algo.stores=applied": getattr(algo, "stores", "commanded") == "applied" and config.env.action != SPEED,
        "levels.draw=prioritised": config.levels.draw == "prioritised",
    }
    for option, chosen in by_step.items():
        if chosen:
            raise IzooError(f"{option} learns from decisions in every step; set env.decide=step, not {decide}.")
