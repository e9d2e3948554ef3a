"""Stable-Baselines3 on the ego environment: one controlled vehicle learns, SUMO drives all others.

Needs ``pip install stable-baselines3``.
"""

from __future__ import annotations

import gymnasium
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor

import izoo.envs  # noqa: F401  # registers izoo/EcoDrivingEgo-v0
from izoo.contexts.procedural import ProceduralSource
from izoo.envs import EnvConfig, RewardConfig


def main(total_timesteps: int = 100_000, steps_per_update: int = 2048, horizon_s: float = 1000.0) -> PPO:
    """Train; return the model, whose ``predict`` maps observations ``[F]`` to accelerations ``[1]``."""
    # eta=0 pays the ego for what it does itself, not for what the whole fleet does.
    config = EnvConfig(horizon_s=horizon_s, reward=RewardConfig(eta=0.0))
    contexts = ProceduralSource({"inflow_vph_per_lane": [250.0, 400.0], "adoption": 0.3})
    env = Monitor(gymnasium.make("izoo.envs:izoo/EcoDrivingEgo-v0", contexts=contexts, config=config))
    model = PPO("MlpPolicy", env, n_steps=steps_per_update, batch_size=64, seed=0, device="cpu", verbose=1)
    model.learn(total_timesteps)
    lives = env.get_episode_lengths()
    print(f"{len(lives)} vehicles driven, {sum(lives)} steps")
    env.close()
    return model


if __name__ == "__main__":
    main()
