"""RLlib's PPO on the PettingZoo view: every controlled vehicle is an agent, and all share one policy.

Needs ``pip install 'izoo[pettingzoo]' 'ray[rllib]'``.
"""

from __future__ import annotations

from typing import Any

import gymnasium
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv

from izoo.contexts.procedural import ProceduralSource
from izoo.envs import EnvConfig, RewardConfig
from izoo.envs.views.pettingzoo import parallel_env

SHARED = "cv"


class EcoDriving(ParallelPettingZooEnv):  # type: ignore[misc]
    """RLlib's wrapper, for agents that appear and leave.

    As it stands, it knows the agents that are there at the first reset alone, and waits for an end that is one for all:
    but at the horizon some vehicles are truncated, and those that left in the same step are terminated.

    Args:
        settings: ``contexts``, ``config``, ``simulator`` and ``max_vehicles`` of
            :func:`izoo.envs.views.pettingzoo.parallel_env`.
    """

    def __init__(self, settings: dict[str, Any]) -> None:
        super().__init__(parallel_env(**settings))
        names = self.possible_agents = self.par_env.possible_agents
        observed: Any = {name: self.par_env.observation_space(name) for name in names}
        acted: Any = {name: self.par_env.action_space(name) for name in names}
        self.observation_spaces, self.observation_space = observed, gymnasium.spaces.Dict(observed)
        self.action_spaces, self.action_space = acted, gymnasium.spaces.Dict(acted)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        result = super().reset(seed=seed, options=options)
        self.agents = self.par_env.agents
        return result

    def step(self, action_dict: dict[Any, Any]) -> tuple[Any, Any, Any, Any, Any]:
        observations, rewards, terminated, truncated, infos = super().step(action_dict)
        self.agents = self.par_env.agents
        terminated["__all__"], truncated["__all__"] = False, not self.agents
        return observations, rewards, terminated, truncated, infos


def main(
    iterations: int = 50, steps_per_iteration: int = 4000, horizon_s: float = 500.0, num_env_runners: int = 2
) -> list[float]:
    """Train; return the mean return of an agent, by iteration."""
    settings = {
        "contexts": ProceduralSource({"inflow_vph_per_lane": [250.0, 400.0], "adoption": 0.3}),
        "config": EnvConfig(horizon_s=horizon_s, reward=RewardConfig(eta=0.0)),
        "simulator": "twin",
        "max_vehicles": 1024,
    }
    config = (
        PPOConfig()
        .environment(EcoDriving, env_config=settings, disable_env_checking=True)
        .env_runners(num_env_runners=num_env_runners, rollout_fragment_length="auto")
        .multi_agent(policies={SHARED}, policy_mapping_fn=lambda agent, *_, **__: SHARED)
        .training(train_batch_size_per_learner=steps_per_iteration, minibatch_size=256, num_epochs=5, lr=3e-4)
        .rl_module(rl_module_spec=RLModuleSpec(model_config={"fcnet_hiddens": [64, 64]}))
        .debugging(seed=0)
    )
    algorithm = config.build_algo()
    returns = []
    try:
        for number in range(iterations):
            result = algorithm.train()["env_runners"]
            returns.append(float(result["module_episode_returns_mean"][SHARED]))
            print(f"iteration {number}: return of a vehicle {returns[-1]:.2f}", flush=True)
    finally:
        algorithm.stop()
    return returns


if __name__ == "__main__":
    main()
