"""Own distributions of contexts: from the features of procedural intersections, from a class, and as a curriculum."""

from __future__ import annotations

import numpy as np

from izoo.contexts.context import Context
from izoo.contexts.distributions import Uniform
from izoo.contexts.procedural import ProceduralSource, procedural_context
from izoo.contexts.source import CurriculumSchedule
from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.envs.env import Contexts

# 1. A distribution per feature: a fixed value, a list, or an interval. Features that are not named stay as they are.
HILLY = ProceduralSource(
    {
        "lane_count": [1, 2],
        "inflow_vph_per_lane": Uniform(200.0, 400.0),
        "grade": Uniform(-0.05, 0.05),
        "adoption": [0.2, 0.5],
        ("green_s", "red_s"): [(20.0, 30.0), (30.0, 20.0)],  # drawn together
    }
)


# 2. Anything with ``sample(generator)``. All randomness comes from the generator, so that runs can be repeated.
class RushHour:
    """More traffic and colder weather, both exponentially distributed around an ordinary day."""

    def sample(self, generator: np.random.Generator) -> Context:
        inflow = min(250.0 + generator.exponential(100.0), 900.0)
        cold = max(10.0 - generator.exponential(10.0), -30.0)
        context = procedural_context(inflow_vph_per_lane=inflow, approach="all")
        return context.replace(temperature_c=cold, season=None)


# 3. A function of the episode's number: here traffic grows over the first 1,000 episodes.
def harder(episode: int, generator: np.random.Generator) -> Context:
    share = min(episode / 1000.0, 1.0)
    return procedural_context(inflow_vph_per_lane=200.0 + 400.0 * share * generator.random())


def main(horizon_s: float = 200.0, episodes: int = 2) -> dict[str, list[str]]:
    """Play some episodes of each; return the names of the contexts."""
    played: dict[str, list[str]] = {}
    sources: dict[str, Contexts] = {"hilly": HILLY, "rush hour": RushHour(), "harder": CurriculumSchedule(harder)}
    for name, contexts in sources.items():
        env = EcoDrivingEnv(contexts, config=EnvConfig(horizon_s=horizon_s), seed=1)
        for _ in range(episodes):
            env.rollout(env.config.control_steps)
            context = env.scene().context
            played.setdefault(name, []).append(context.name)
            print(f"{name:10s} {context.name:45s} {context.temperature_c:6.1f} C  adoption {context.adoption:.2f}")
        env.close()
    return played


if __name__ == "__main__":
    main()
