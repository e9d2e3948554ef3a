"""How the arrays of a frame become a TensorDict, and an action goes into them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from izoo.envs.config import SPEED, STEP, EnvConfig
from izoo.envs.frame_copies import Copies, Layout, Tensors
from izoo.envs.mdp.columns import VEHICLE_FLAGS, VEHICLE_FLOATS, VEHICLE_INTS
from izoo.envs.mdp.frame import CONTEXT_IDS, CONTEXT_VALUES, TOTALS, row_of
from izoo.envs.mdp.metric_sums import APPROACH_METRICS, EPISODE_METRICS
from izoo.envs.specs import DONE, optional
from izoo.errors import IzooError

COMMANDS = {name: ("agents", name) for name in ("action", "defer", "lane_change")}
"""What can be commanded: the key of each array of a frame that the parent writes."""
_AGENT_LEAVES = {"observation": "observation", "mask": "mask", "vehicle": "agent_vehicle"}
"""Arrays of a frame by their key under ``"agents"``, ``[*B, A, ...]``, besides :func:`~izoo.envs.specs.optional`."""
_AGENT_COLUMNS = {"reward": "reward", **{name: f"agent_{name}" for name in DONE}}
"""The same for those that TorchRL wants as ``[*B, A, 1]``."""
_VEHICLE_COLUMNS = {"vehicle_floats": VEHICLE_FLOATS, "vehicle_ints": VEHICLE_INTS, "vehicle_flags": VEHICLE_FLAGS}
_OF_GROUP = {
    "vehicles": tuple(_VEHICLE_COLUMNS),
    "signal": ("signal_colour", "signal_time_left_s"),
    "context": ("context_values", "context_ids"),
    "metrics": (TOTALS, "approach_mask"),
    "reward_vector": ("reward_vector",),
}
"""Arrays of the groups of ``config.emit``."""


class Outlet(Protocol):
    """Memory for what a step emits: a step, or another look at the frames, begins, is taken, and is handed on."""

    def begin(self, stepping: bool) -> None:
        """Begin a step, or another look at the frames."""
        ...

    def take(self, rows: slice) -> None:
        """Take the frames of some environments; threads do so side by side, each for its own."""
        ...

    def tensors(self) -> tuple[Tensors, Tensors]:
        """Return the arrays ``[*B, ...]`` that the step leads to, and those to act on next, by name."""
        ...


ROUNDING = 1e-5
"""How far above 1 a share may lie: that of a policy's single precision."""


class FrameReader:
    """Turns the arrays of frames into TensorDicts, in memory that :attr:`outlet` has.

    Attributes:
        layout: of what is emitted.
        outlet: where it goes; by default copies that own their memory.
        vehicle_names: entries of the group of vehicles that are emitted; ``None``: all.

    Args:
        config: the environment's settings.
        frames: ``[N, ...]`` as made by :func:`izoo.envs.mdp.frame.map_frames`.
        batch: batch size of the environment: ``[N]``, or ``[]`` for a single one.
        leaves: arrays that are emitted at the root under their own names.
    """

    def __init__(
        self, config: EnvConfig, frames: dict[str, np.ndarray], batch: torch.Size, leaves: Sequence[str] = ()
    ) -> None:
        self.config, self.batch = config, batch
        self.agents_batch = torch.Size((*batch, config.num_agents))
        self.vehicle_names: tuple[str, ...] | None = None
        arrays = frames if batch else row_of(frames, 0)
        self._defer = arrays["defer"].view(bool)
        self._deferring = True
        self.tensors: dict[str, Tensor] = {}
        for name, array in arrays.items():
            tensor = torch.from_numpy(array)
            self.tensors[name] = tensor.view(torch.bool) if array.dtype == np.uint8 else tensor
        self._agent_leaves = _AGENT_LEAVES | {name: name for name in optional(config)}
        self._leaves = (*DONE, *leaves)
        names = [*self._agent_leaves.values(), *_AGENT_COLUMNS.values(), *self._leaves]
        names += [name for group in config.emit for name in _OF_GROUP.get(group, ())]
        self.layout = Layout(frames, batch, names)
        self.outlet: Outlet = Copies(self.layout)
        self.action_shape = torch.Size((*self.agents_batch, config.action_size))
        self._action = self.tensors["action"]
        self._prepared: tuple[TensorDict, TensorDict] | None = None

    def _check_action(self, tensordict: TensorDictBase) -> None:
        """Check the action keys.

        Raises:
            IzooError: an action is missing, is of another shape or type than its spec, or is no share or lane change.
        """
        agents = tensordict.get("agents", None)
        action = None if agents is None else agents.get("action", None)
        if action is None or action.shape != self.action_shape or not action.is_floating_point():
            got = "missing" if action is None else f"{action.dtype} of shape {list(action.shape)}"
            parts = ", ".join(self.config.action_parts)
            what = f"shares of the speed limit ({parts})" if self.config.action == SPEED else "accelerations in m/s^2"
            raise IzooError(
                f"('agents', 'action') is {got}; give {what} as a float tensor of shape {list(self.action_shape)}."
            )
        defer = agents.get("defer", None)
        if defer is not None and defer.numel() != self.agents_batch.numel():
            shape = list(self.agents_batch)
            raise IzooError(f"('agents', 'defer') is of shape {list(defer.shape)}; give flags of shape {shape}.")
        if self.config.action == SPEED:
            self._check_shares(action, defer)
        if self.config.lane_change:
            self._check_lane_change(agents.get("lane_change", None))

    def _check_shares(self, action: Tensor, defer: Tensor | None) -> None:
        asked = self.tensors["mask" if self.config.decide == STEP else "decides"]
        if defer is not None:
            asked = asked & (defer.reshape(asked.shape) == 0)
        wrong = action[asked & ((action <= 0.0) | (action > 1.0 + ROUNDING)).any(-1)]
        if len(wrong) > 0:
            raise IzooError(
                f"('agents', 'action') asks for desired speeds of {wrong.flatten()[:5].tolist()}; give shares of the "
                "speed limit above 0 and up to 1, which leaves the vehicle alone, or set ('agents', 'defer')."
            )

    def _check_lane_change(self, lanes: Tensor | None) -> None:
        legal = self.tensors["lane_change"].shape
        whole = lanes is not None and lanes.shape == legal and not lanes.is_floating_point()
        if lanes is None or not whole or not ((lanes >= 0) & (lanes <= 2)).all():
            got = "missing" if lanes is None else f"{lanes.dtype} of shape {list(lanes.shape)}"
            values = "" if lanes is None else f" with the values {lanes.unique()[:5].tolist()}"
            raise IzooError(
                f"('agents', 'lane_change') is {got}{values}; with lane_change=True, give whole numbers of shape "
                f"{list(legal)}: 0 right, 1 keep, 2 left. izoo's own learners and drivers command accelerations alone; "
                "for them leave lane_change off."
            )

    def write_action(self, tensordict: TensorDictBase) -> None:
        """Copy the action keys into the frames, checked: see :meth:`_check_action`."""
        self._check_action(tensordict)
        agents = tensordict.get("agents", None)
        self._action.copy_(agents.get("action", None).detach())
        defer = agents.get("defer", None)
        self._write_defer(None if defer is None else defer.detach().reshape(self.agents_batch).numpy())
        if self.config.lane_change:
            self.tensors["lane_change"].copy_(agents.get("lane_change", None))

    def _write_defer(self, defer: np.ndarray | None) -> None:
        # If interrupted here, it is still recorded that flags may be set.
        if defer is not None:
            self._deferring = True
            np.not_equal(defer, 0, out=self._defer)
        elif self._deferring:
            self._defer.fill(0)
            self._deferring = False

    def begin(self, stepping: bool = False) -> None:
        """Begin a step, or another look at the frames, which are then to be taken: see :class:`Outlet`."""
        self._prepared = None
        self.outlet.begin(stepping)

    def prepare(self) -> None:
        """Do that part of the next :meth:`read` which does not need the frames, while they are waited for."""
        if self._prepared is None:
            led_to, acted_on = self.outlet.tensors()
            following, state = self.assemble(led_to, self.batch)
            self._prepared = following, state if acted_on is led_to else self.assemble(acted_on, self.batch)[1]

    def take(self, rows: slice) -> None:
        """Take the frames of some environments for the next :meth:`read`."""
        self.outlet.take(rows)

    def read(self) -> tuple[TensorDict, TensorDict]:
        """Return what a step led to, with the reward, and the state to act on next, which has none.

        Everything in :func:`~izoo.envs.specs.observation_spec` and the done flags are there. They share their tensors,
        unless :attr:`outlet` says otherwise.
        """
        self.prepare()
        prepared, self._prepared = self._prepared, None
        assert prepared is not None
        return prepared

    def assemble(self, tensors: Tensors, batch: torch.Size) -> tuple[TensorDict, TensorDict]:
        """Return the arrays of a frame, ``[*batch, ...]`` each, as what a step led to, and without reward to act on."""
        agents_batch = torch.Size((*batch, self.config.num_agents))
        agents = {key: tensors[name] for key, name in self._agent_leaves.items()}
        agents |= {key: tensors[name].unsqueeze(-1) for key, name in _AGENT_COLUMNS.items()}
        if "reward_vector" in self.config.emit:
            agents["reward_vector"] = tensors["reward_vector"]
        frame: dict[str, Tensor | TensorDict] = {name: tensors[name] for name in self._leaves}
        frame |= {group: add(self, tensors, batch) for group, add in _GROUPS.items() if group in self.config.emit}
        following = _new({**frame, "agents": _new({**agents}, agents_batch)}, batch)
        del agents["reward"]
        return following, _new({**frame, "agents": _new(agents, agents_batch)}, batch)

    def _vehicles(self, tensors: Tensors, batch: torch.Size) -> TensorDict:
        columns: dict[str, Tensor] = {}
        for name, names in _VEHICLE_COLUMNS.items():
            columns |= zip(names, tensors[name].unbind(-1), strict=True)
        if self.vehicle_names is not None:
            columns = {name: columns[name] for name in self.vehicle_names}
        return _new(columns, torch.Size((*batch, self.config.num_vehicles)))

    def _signal(self, tensors: Tensors, batch: torch.Size) -> TensorDict:
        signal = {"colour": tensors["signal_colour"], "time_left_s": tensors["signal_time_left_s"]}
        return _new(signal, torch.Size((*batch, self.config.num_approaches)))

    def _context(self, tensors: Tensors, batch: torch.Size) -> TensorDict:
        columns = dict(zip(CONTEXT_VALUES, tensors["context_values"].split(1, -1), strict=True))
        columns |= dict(zip(CONTEXT_IDS, tensors["context_ids"].split(1, -1), strict=True))
        return _new(columns, batch)

    def _metrics(self, tensors: Tensors, batch: torch.Size) -> TensorDict:
        """Sums of the episode so far."""
        episode, approach = tensors[TOTALS].tensor_split([len(EPISODE_METRICS)], -1)
        sums = dict(zip(EPISODE_METRICS, episode.split(1, -1), strict=True))
        by_approach = approach.unflatten(-1, (-1, len(APPROACH_METRICS)))
        columns = dict(zip(APPROACH_METRICS, by_approach.unbind(-1), strict=True))
        columns["mask"] = tensors["approach_mask"]
        p = torch.Size((*batch, self.config.num_approaches))
        return _new({"approach": _new(columns, p), "episode": _new(sums, batch)}, batch)


_GROUPS = {
    "vehicles": FrameReader._vehicles,
    "signal": FrameReader._signal,
    "context": FrameReader._context,
    "metrics": FrameReader._metrics,
}


def set_entry(tensordict: TensorDictBase, key: str, value: Any) -> None:
    """Set an entry whose shape is known to be right."""
    tensordict._set_str(key, value, validated=True, inplace=False, non_blocking=False)


def _new(columns: dict[str, Tensor] | dict[str, TensorDict | Tensor], batch: torch.Size) -> TensorDict:
    # The specs' test compares shapes once; checking them in every step would cost more than the copies.
    return TensorDict._new_unsafe(columns, batch_size=batch)
