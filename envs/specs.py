"""What an environment emits, as TorchRL specs, and how a frame's arrays become a TensorDict.

Shapes: ``[*B, A, F]`` with ``B`` environments, ``A`` agent slots, ``F`` features; ``V`` vehicle slots, ``P``
approaches.
"""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from izoo.envs.config import ACTION_HIGH_MPS2, ACTION_LOW_MPS2, EnvConfig
from izoo.envs.layout import (
    CONTEXT_VALUES,
    REWARD_VECTOR,
    VEHICLE_FLAGS,
    VEHICLE_FLOATS,
    VEHICLE_INTS,
    observation_names,
)
from izoo.errors import IzooError
from izoo.metrics.definitions import APPROACH_METRICS, EPISODE_METRICS

_CONTEXT_IDS = ("episode", "context_id", "seed")


def observation_spec(config: EnvConfig, batch: torch.Size) -> Composite:
    """Spec of everything emitted at reset and step, but reward and done."""
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
    if "context" in config.emit:
        root["context"] = context_spec(batch)
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
    if "reward_vector" in config.emit:
        agents["reward_vector"] = Unbounded((*batch, a, len(REWARD_VECTOR)))
    return agents


def _metrics(config: EnvConfig, batch: torch.Size) -> Composite:
    p = (*batch, config.num_approaches)
    approach = Composite({name: Unbounded(p) for name in APPROACH_METRICS}, shape=p)
    approach["mask"] = _flag(p)
    episode = Composite({name: Unbounded((*batch, 1)) for name in EPISODE_METRICS}, shape=batch)
    return Composite(approach=approach, episode=episode, shape=batch)


def context_spec(batch: torch.Size) -> Composite:
    """Spec of the context group, part of the observation spec and of the state spec."""
    one = (*batch, 1)
    columns: dict[str, Unbounded] = {name: Unbounded(one) for name in CONTEXT_VALUES}
    columns |= {name: Unbounded(one, dtype=torch.int64) for name in _CONTEXT_IDS}
    return Composite(columns, shape=batch)


def action_spec(config: EnvConfig, batch: torch.Size) -> Composite:
    """Acceleration in m/s^2 per agent slot, and the lane change where it is enabled."""
    a = (*batch, config.num_agents)
    agents = Composite(action=Bounded(ACTION_LOW_MPS2, ACTION_HIGH_MPS2, (*a, 1)), shape=a)
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
    names = ("done", "terminated", "truncated")
    agents = Composite({name: _flag((*a, 1)) for name in names}, shape=a)
    return Composite({"agents": agents} | {name: _flag((*batch, 1)) for name in names}, shape=batch)


class FrameReader:
    """Turns the arrays of frames into TensorDicts that own their memory.

    Args:
        config: the environment's settings.
        arrays: frames as made by :func:`izoo.envs.layout.map_frames`; for ``batch`` of ``[]`` their single row.
        batch: batch size of the environment.
    """

    def __init__(self, config: EnvConfig, arrays: dict[str, np.ndarray], batch: torch.Size) -> None:
        self.config, self.batch = config, batch
        self.tensors: dict[str, Tensor] = {}
        for name, array in arrays.items():
            tensor = torch.from_numpy(array)
            self.tensors[name] = tensor.view(torch.bool) if array.dtype == np.uint8 else tensor
        self.agents_batch = torch.Size((*batch, config.num_agents))
        self.action_shape = torch.Size((*batch, config.num_agents, 1))

    def write_action(self, tensordict: TensorDict) -> None:
        """Copy the action keys into the frames.

        Raises:
            IzooError: the action is missing, or has another shape than ``[*B, A, 1]``.
        """
        tensors = self.tensors
        action = tensordict.get(("agents", "action"), None)
        if action is None or action.shape != self.action_shape or not action.is_floating_point():
            got = "missing" if action is None else f"{action.dtype} of shape {list(action.shape)}"
            raise IzooError(
                f"('agents', 'action') is {got}; give accelerations in m/s^2 as a float tensor of shape "
                f"{list(self.action_shape)}."
            )
        tensors["action"].copy_(action.squeeze(-1))
        defer = tensordict.get(("agents", "defer"), None)
        if defer is None:
            tensors["defer"].zero_()
        else:
            tensors["defer"].copy_(defer.reshape(tensors["defer"].shape))
        if self.config.lane_change:
            tensors["lane_change"].copy_(tensordict.get(("agents", "lane_change")))

    def observation(self) -> dict[str, TensorDict | Tensor]:
        """Read everything in :func:`observation_spec` and the done flags."""
        t, emit = self.tensors, self.config.emit
        agents = {
            "observation": t["observation"].clone(),
            "mask": t["mask"].clone(),
            "vehicle": t["agent_vehicle"].clone(),
            "terminated": t["agent_terminated"].unsqueeze(-1).clone(),
            "truncated": t["agent_truncated"].unsqueeze(-1).clone(),
        }
        agents["done"] = agents["terminated"] | agents["truncated"]
        if "reward_vector" in emit:
            agents["reward_vector"] = t["reward_vector"].clone()
        root: dict[str, TensorDict | Tensor] = {
            "terminated": t["terminated"].clone(),
            "truncated": t["truncated"].clone(),
        }
        root["done"] = root["terminated"] | root["truncated"]
        root["agents"] = _new(agents, self.agents_batch)
        if "vehicles" in emit:
            root["vehicles"] = self._vehicles()
        if "signal" in emit:
            signal = {"colour": t["signal_colour"].clone(), "time_left_s": t["signal_time_left_s"].clone()}
            root["signal"] = _new(signal, torch.Size((*self.batch, self.config.num_approaches)))
        if "context" in emit:
            root["context"] = self.context()
        if "metrics" in emit:
            root["metrics"] = self._metrics()
        return root

    def reward(self) -> Tensor:
        """Read the reward ``[*B, A, 1]``."""
        return self.tensors["reward"].unsqueeze(-1).clone()

    def context(self) -> TensorDict:
        """Read the context group."""
        values, ids = self.tensors["context_values"].clone(), self.tensors["context_ids"].clone()
        columns = dict(zip(CONTEXT_VALUES, values.split(1, -1), strict=True))
        columns |= dict(zip(_CONTEXT_IDS, ids.split(1, -1), strict=True))
        return _new(columns, self.batch)

    def _vehicles(self) -> TensorDict:
        t = self.tensors
        columns = dict(zip(VEHICLE_FLOATS, t["vehicle_floats"].clone().unbind(-1), strict=True))
        columns |= dict(zip(VEHICLE_INTS, t["vehicle_ints"].clone().unbind(-1), strict=True))
        columns |= dict(zip(VEHICLE_FLAGS, t["vehicle_flags"].clone().unbind(-1), strict=True))
        return _new(columns, torch.Size((*self.batch, self.config.num_vehicles)))

    def _metrics(self) -> TensorDict:
        approach = dict(zip(APPROACH_METRICS, self.tensors["approach_metrics"].clone().unbind(-1), strict=True))
        approach["mask"] = self.tensors["approach_mask"].clone()
        episode = dict(zip(EPISODE_METRICS, self.tensors["episode_metrics"].clone().split(1, -1), strict=True))
        p = torch.Size((*self.batch, self.config.num_approaches))
        return _new({"approach": _new(approach, p), "episode": _new(episode, self.batch)}, self.batch)


def _new(columns: dict[str, Tensor] | dict[str, TensorDict | Tensor], batch: torch.Size) -> TensorDict:
    # The specs' test compares shapes once; checking them in every step would cost more than the copies.
    return TensorDict._new_unsafe(columns, batch_size=batch)
