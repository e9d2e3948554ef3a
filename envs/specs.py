"""What an environment emits, as TorchRL specs.

Shapes: ``[*B, A, F]`` with ``B`` environments, ``A`` agent slots, ``F`` features; ``V`` vehicle slots, ``P``
approaches.
"""

from __future__ import annotations

import torch
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, MIN_SHARE, SPEED, STEP, EnvConfig
from izoo.envs.mdp.columns import VEHICLE_FLAGS, VEHICLE_FLOATS, VEHICLE_INTS
from izoo.envs.mdp.frame import CONTEXT_IDS, CONTEXT_VALUES, TEAM_REWARD, observation_names
from izoo.envs.mdp.metric_sums import APPROACH_METRICS, EPISODE_METRICS
from izoo.envs.mdp.reward import REWARD_VECTOR

DONE = ("terminated", "truncated", "done")


def optional(config: EnvConfig) -> tuple[str, ...]:
    """Return the leaves ``[*B, A]`` under ``"agents"`` that not every environment emits."""
    return ("decides", "number") if config.decide != STEP else ("number",) if "number" in config.emit else ()


def observation_spec(config: EnvConfig, batch: torch.Size) -> Composite:
    """Spec of everything emitted at reset and step, except reward and done."""
    a, f = config.num_agents, len(observation_names(config))
    root = Composite(agents=_agents(config, batch, a, f), shape=batch)
    if "vehicles" in config.emit:
        v = (*batch, config.num_vehicles)
        columns: dict[str, Unbounded | Categorical] = {name: Unbounded(v) for name in VEHICLE_FLOATS}
        columns |= {name: Unbounded(v, dtype=torch.int32) for name in VEHICLE_INTS}
        columns |= {name: _flag(v) for name in VEHICLE_FLAGS}
        root["vehicles"] = Composite(columns, shape=v)
    if "signal" in config.emit:
        p = (*batch, config.num_approaches, config.num_approaches)
        root["signal"] = Composite(
            colour=Unbounded(p, dtype=torch.int32), time_left_s=Unbounded(p), shape=(*batch, config.num_approaches)
        )
    if TEAM_REWARD in config.emit:
        root[TEAM_REWARD] = Unbounded((*batch, 1))
    if "context" in config.emit:
        columns = {name: Unbounded((*batch, 1)) for name in CONTEXT_VALUES}
        columns |= {name: Unbounded((*batch, 1), dtype=torch.int64) for name in CONTEXT_IDS}
        root["context"] = Composite(columns, shape=batch)
    if "metrics" in config.emit:
        root["metrics"] = _metrics(config, batch)
    return root


def _flag(shape: tuple[int, ...]) -> Categorical:
    return Categorical(2, shape=shape, dtype=torch.bool)


def _agents(config: EnvConfig, batch: torch.Size, a: int, f: int) -> Composite:
    agents = Composite(
        observation=Unbounded((*batch, a, f)),
        mask=_flag((*batch, a)),
        vehicle=Unbounded((*batch, a), dtype=torch.int64),
        shape=(*batch, a),
    )
    columns = {"decides": _flag((*batch, a)), "number": Unbounded((*batch, a), dtype=torch.int64)}
    for name in optional(config):
        agents[name] = columns[name]
    if "reward_vector" in config.emit:
        agents["reward_vector"] = Unbounded((*batch, a, len(REWARD_VECTOR)))
    return agents


def _metrics(config: EnvConfig, batch: torch.Size) -> Composite:
    p = (*batch, config.num_approaches)
    approach = Composite({name: Unbounded(p) for name in APPROACH_METRICS}, shape=p)
    approach["mask"] = _flag(p)
    episode = Composite({name: Unbounded((*batch, 1)) for name in EPISODE_METRICS}, shape=batch)
    return Composite(approach=approach, episode=episode, shape=batch)


def action_spec(config: EnvConfig, batch: torch.Size) -> Composite:
    """Per agent slot an acceleration in m/s^2 or shares of the speed limit, and the lane change where it is enabled."""
    a = (*batch, config.num_agents)
    low, high = (MIN_SHARE, 1.0) if config.action == SPEED else (ACTION_LOW_MPS2, ACTION_HIGH_MPS2)
    agents = Composite(action=Bounded(low, high, (*a, config.action_size)), shape=a)
    if config.lane_change:
        agents["lane_change"] = Categorical(3, shape=a)
    return Composite(agents=agents, shape=batch)


def reward_spec(config: EnvConfig, batch: torch.Size) -> Composite:
    """Reward per agent slot; 0 for slots that did not act."""
    a = (*batch, config.num_agents)
    return Composite(agents=Composite(reward=Unbounded((*a, 1)), shape=a), shape=batch)


def done_spec(config: EnvConfig, batch: torch.Size) -> Composite:
    """Per agent: left the region (terminated) or ran out of time (truncated); at the root: the episode."""
    a = (*batch, config.num_agents)
    agents = Composite({name: _flag((*a, 1)) for name in DONE}, shape=a)
    return Composite({"agents": agents} | {name: _flag((*batch, 1)) for name in DONE}, shape=batch)
