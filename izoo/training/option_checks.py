"""Which options of a training run go together."""

from __future__ import annotations

from izoo.conf.train_options import TrainConfig
from izoo.envs import simulator_of
from izoo.envs.config import STEP
from izoo.errors import IzooError
from izoo.gpu import check_gpu
from izoo.results import ray_cluster
from izoo.training.learner import learner_device


def check_options(config: TrainConfig) -> None:
    """Raise :class:`IzooError` where options of a run do not go together, or need what is not installed here."""
    learner_device(config.device)
    if config.env.lane_change:
        raise IzooError(
            "env.lane_change=true asks the policy for lane changes as well, and none of izoo's learners commands them; "
            "leave it out."
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
    algo, decide = config.algo, config.env.decide
    if algo.variate != "none" and not simulator.batched:
        raise IzooError(
            f"algo.control_variate={algo.variate} plays every training episode a second time, uncommanded, which "
            f"{simulator.label} does not do during training; choose simulator=twin, or algo.control_variate=none."
        )
    common_noise = getattr(algo, "common_noise", 0.0)
    if common_noise > 0.0 and (not simulator.batched or decide == STEP):
        raise IzooError(
            f"algo.common_noise={common_noise:g} lets all vehicles of an episode explore together, but simulator is "
            f"{config.simulator} and env.decide {decide}; choose simulator=twin and env.decide=vehicle, or "
            "algo.common_noise=0."
        )
    by_step = algo.by_step(config)
    if config.action.every_step:
        by_step += (f"action={config.action.name}",)
    if config.levels.draw == "prioritised":
        by_step += ("levels.draw=prioritised",)
    if by_step and decide != STEP:
        raise IzooError(f"{by_step[0]} learns from decisions in every step; set env.decide=step, not {decide}.")
    policies, envs = algo.candidates, config.environments
    if policies > 1 and (not simulator.batched or envs % policies or config.env.reward.eta != 1.0):
        raise IzooError(
            f"algo={algo.name} lets {policies} policies play the same episodes side by side and compares "
            f"their teams' rewards, but simulator is {config.simulator}, num_envs {envs} and env.reward.eta "
            f"{config.env.reward.eta:g}; choose simulator=twin, a multiple of {policies} for num_envs, and "
            "env.reward=fuel_team or env.reward.eta=1."
        )
    if config.collector == "ray":
        ray_cluster.connect()
