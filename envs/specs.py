"""What an environment emits, as TorchRL specs, and how a frame's arrays become a TensorDict.

Shapes: ``[*B, A, F]`` with ``B`` environments, ``A`` agent slots, ``F`` features; ``V`` vehicle slots, ``P``
approaches.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
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


class _Copies:
    """Fresh copies of one array, a step each.

    Making a tensor costs more than copying a few hundred bytes into one, so small copies are cut from a larger block,
    some dozens at a time.

    Args:
        source: the array.
        shape: of the copies.
    """

    PER_BLOCK = 32

    def __init__(self, source: np.ndarray, shape: tuple[int, ...]) -> None:
        self._source, self._shape = source, shape
        self._dtype = torch.bool if source.dtype == np.uint8 else torch.from_numpy(source).dtype
        self._targets: Iterator[tuple[Tensor, np.ndarray]] = iter(())

    def take(self) -> Tensor:
        """Return what the array holds now, as a tensor that nobody else has."""
        pair = next(self._targets, None)
        if pair is None:
            block = torch.empty((self.PER_BLOCK, *self._shape), dtype=self._dtype)
            arrays = block.view(self.PER_BLOCK, *self._source.shape).numpy().view(self._source.dtype)
            self._targets = zip(block.unbind(0), arrays, strict=True)
            pair = next(self._targets)
        pair[1][...] = self._source
        return pair[0]


class FrameReader:
    """Turns the arrays of frames into TensorDicts that own their memory.

    Args:
        config: the environment's settings.
        arrays: frames as made by :func:`izoo.envs.layout.map_frames`; for ``batch`` of ``[]`` their single row.
        batch: batch size of the environment.
        leaves: arrays that are emitted at the root under their own names.
    """

    def __init__(
        self, config: EnvConfig, arrays: dict[str, np.ndarray], batch: torch.Size, leaves: Sequence[str] = ()
    ) -> None:
        self.config, self.batch = config, batch
        agents = (*batch, config.num_agents)
        self._defer = arrays["defer"]
        self._deferring = True
        self._observation = torch.from_numpy(arrays["observation"])
        self._reward = _Copies(arrays["reward"], (*agents, 1))
        self._agents = {
            "mask": _Copies(arrays["mask"], agents),
            "vehicle": _Copies(arrays["agent_vehicle"], agents),
            "terminated": _Copies(arrays["agent_terminated"], (*agents, 1)),
            "truncated": _Copies(arrays["agent_truncated"], (*agents, 1)),
            "done": _Copies(arrays["agent_done"], (*agents, 1)),
        }
        roots = {name: name for name in ("terminated", "truncated", "done", *leaves)}
        self._root = {key: _Copies(arrays[name], arrays[name].shape) for key, name in roots.items()}
        self.tensors: dict[str, Tensor] = {}
        for name, array in arrays.items():
            tensor = torch.from_numpy(array)
            self.tensors[name] = tensor.view(torch.bool) if array.dtype == np.uint8 else tensor
        self.agents_batch = torch.Size(agents)
        self.action_shape = torch.Size((*agents, 1))
        self._action = self.tensors["action"].unsqueeze(-1)

    def write_action(self, tensordict: TensorDict) -> None:
        """Copy the action keys into the frames.

        Raises:
            IzooError: an action is missing, is of another shape or type than its spec, or is no lane change.
        """
        agents = tensordict._get_str("agents", None)
        action = None if agents is None else agents.get("action", None)
        if action is None or action.shape != self.action_shape or not action.is_floating_point():
            got = "missing" if action is None else f"{action.dtype} of shape {list(action.shape)}"
            raise IzooError(
                f"('agents', 'action') is {got}; give accelerations in m/s^2 as a float tensor of shape "
                f"{list(self.action_shape)}."
            )
        self._action.copy_(action)
        defer = agents.get("defer", None)
        if defer is not None:
            self.tensors["defer"].copy_(self._flags(defer))
        elif self._deferring:
            self._defer.fill(0)
        self._deferring = defer is not None
        if self.config.lane_change:
            self.tensors["lane_change"].copy_(self._lane_change(agents))

    def _flags(self, defer: Tensor) -> Tensor:
        """Return the defer flags ``[*B, A]``, checked."""
        if defer.numel() != self.agents_batch.numel():
            shape = list(self.agents_batch)
            raise IzooError(f"('agents', 'defer') is of shape {list(defer.shape)}; give flags of shape {shape}.")
        return defer.reshape(self.agents_batch)

    def _lane_change(self, agents: TensorDictBase) -> Tensor:
        """Return the lane changes ``[*B, A]``, checked."""
        lanes, legal = agents.get("lane_change", None), self.tensors["lane_change"].shape
        whole = lanes is not None and lanes.shape == legal and not lanes.is_floating_point()
        if lanes is None or not whole or not ((lanes >= 0) & (lanes <= 2)).all():
            got = "missing" if lanes is None else f"{lanes.dtype} of shape {list(lanes.shape)}"
            values = "" if lanes is None else f" with the values {lanes.unique()[:5].tolist()}"
            raise IzooError(
                f"('agents', 'lane_change') is {got}{values}; with lane_change=True, give whole numbers of shape "
                f"{list(legal)}: 0 right, 1 keep, 2 left. izoo's own learners and drivers command accelerations alone; "
                "for them leave lane_change off."
            )
        return lanes

    def observation(self) -> dict[str, TensorDict | Tensor]:
        """Read everything in :func:`observation_spec` and the done flags."""
        t, emit = self.tensors, self.config.emit
        agents = {"observation": self._observation.clone()}
        for name, copies in self._agents.items():
            agents[name] = copies.take()
        if "reward_vector" in emit:
            agents["reward_vector"] = t["reward_vector"].clone()
        root: dict[str, TensorDict | Tensor] = {name: copies.take() for name, copies in self._root.items()}
        root["agents"] = _new(agents, self.agents_batch)
        if "vehicles" in emit:
            root["vehicles"] = self._vehicles()
        if "signal" in emit:
            signal = {"colour": t["signal_colour"].clone(), "time_left_s": t["signal_time_left_s"].clone()}
            root["signal"] = _new(signal, torch.Size((*self.batch, self.config.num_approaches)))
        if "context" in emit:
            root["context"] = self.context()
        if "metrics" in emit:
            root["metrics"] = self.metrics()
        return root

    def reward(self) -> Tensor:
        """Read the reward ``[*B, A, 1]``."""
        return self._reward.take()

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

    def metrics(self) -> TensorDict:
        """Read the metrics group: sums of the episode so far."""
        approach = dict(zip(APPROACH_METRICS, self.tensors["approach_metrics"].clone().unbind(-1), strict=True))
        approach["mask"] = self.tensors["approach_mask"].clone()
        episode = dict(zip(EPISODE_METRICS, self.tensors["episode_metrics"].clone().split(1, -1), strict=True))
        p = torch.Size((*self.batch, self.config.num_approaches))
        return _new({"approach": _new(approach, p), "episode": _new(episode, self.batch)}, self.batch)


def _new(columns: dict[str, Tensor] | dict[str, TensorDict | Tensor], batch: torch.Size) -> TensorDict:
    # The specs' test compares shapes once; checking them in every step would cost more than the copies.
    return TensorDict._new_unsafe(columns, batch_size=batch)
