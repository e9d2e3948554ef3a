"""How the arrays of a frame become a TensorDict, and an action goes into them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from izoo.envs.config import SPEED, STEP, EnvConfig
from izoo.envs.mdp.columns import VEHICLE_FLAGS, VEHICLE_FLOATS, VEHICLE_INTS
from izoo.envs.mdp.frame import CONTEXT_IDS, CONTEXT_VALUES
from izoo.envs.mdp.metric_sums import APPROACH_METRICS, EPISODE_METRICS
from izoo.envs.specs import DONE, optional
from izoo.errors import IzooError

COMMANDS = {name: ("agents", name) for name in ("action", "defer", "lane_change")}
"""What can be commanded: the key of each array of a frame that the parent writes."""
_AGENT_LEAVES = {"mask": "mask", "vehicle": "agent_vehicle"}
"""Arrays of a frame by their key under ``"agents"``, ``[*B, A]``; and those of :func:`~izoo.envs.specs.optional`."""
_AGENT_COLUMNS = {"reward": "reward", **{name: f"agent_{name}" for name in DONE}}
"""The same for those that TorchRL wants as ``[*B, A, 1]``."""


class Observations(Protocol):
    """Where the observations of a frame go, by far the largest of its arrays.

    A step calls :meth:`begin`, perhaps :meth:`take`, and :meth:`read`.
    """

    def begin(self) -> None:
        """Begin a step."""
        ...

    def take(self, rows: slice) -> None:
        """Take the observations of some environments. Threads that wrote them do so side by side, each for its own."""
        ...

    def read(self, stepped: bool) -> tuple[Tensor, Tensor]:
        """Return the observations ``[*B, A, F]`` that a step led to, and those to act on next.

        Args:
            stepped: a step has just ended, and no frame changed since: what was taken is not taken again.
        """
        ...


class Copies:
    """Observations that own their memory, copied whole in every step.

    Args:
        source: ``[*B, A, F]`` those of the frames.
    """

    def __init__(self, source: np.ndarray) -> None:
        self._source = source
        self._blank: np.ndarray | None = None
        self._taken: list[slice] = []

    def begin(self) -> None:
        """Begin a step: ask for the memory of its copy."""
        self._taken = []
        if self._blank is None:
            self._blank = np.empty_like(self._source)

    def take(self, rows: slice) -> None:
        """Copy those of some environments, in a step that has begun."""
        blank, taken = self._blank, self._taken
        if blank is not None:
            np.copyto(blank[rows], self._source[rows])
            taken.append(rows)

    def read(self, stepped: bool) -> tuple[Tensor, Tensor]:
        """Return the copy, twice."""
        blank, self._blank = self._blank, None
        if blank is None:
            blank = self._source.copy()
        elif not (stepped and sum(rows.stop - rows.start for rows in self._taken) == len(blank)):
            np.copyto(blank, self._source)
        copy = torch.from_numpy(blank)
        return copy, copy


ROUNDING = 1e-5
"""How far above 1 a share may lie: that of a policy's single precision."""


class FrameReader:
    """Turns the arrays of frames into TensorDicts that own their memory, unless :attr:`observations` says otherwise.

    Attributes:
        observations: where these go.
        vehicle_names: entries of the group of vehicles that are emitted; ``None``: all.

    Args:
        config: the environment's settings.
        arrays: frames as made by :func:`izoo.envs.mdp.frame.map_frames`; for ``batch`` of ``[]`` their single row.
        batch: batch size of the environment.
        leaves: arrays that are emitted at the root under their own names.
    """

    def __init__(
        self, config: EnvConfig, arrays: dict[str, np.ndarray], batch: torch.Size, leaves: Sequence[str] = ()
    ) -> None:
        self.config, self.batch = config, batch
        self.agents_batch = torch.Size((*batch, config.num_agents))
        self.vehicle_names: tuple[str, ...] | None = None
        self._defer = arrays["defer"].view(bool)
        self._deferring = True
        self.tensors: dict[str, Tensor] = {}
        for name, array in arrays.items():
            tensor = torch.from_numpy(array)
            self.tensors[name] = tensor.view(torch.bool) if array.dtype == np.uint8 else tensor
        agent_leaves = _AGENT_LEAVES | {name: name for name in optional(config)}
        self._agent_keys = (*agent_leaves, *_AGENT_COLUMNS)
        self._root_keys = (*DONE, *leaves)
        sources = [self.tensors[name] for name in agent_leaves.values()]
        sources += [self.tensors[name].unsqueeze(-1) for name in _AGENT_COLUMNS.values()]
        sources += [self.tensors[name] for name in self._root_keys]
        self._sources = [tensor.numpy() for tensor in sources]
        self.action_shape = torch.Size((*self.agents_batch, config.action_size))
        self._action = self.tensors["action"][..., : config.action_size]
        self.tensors["action"][..., config.action_size :] = 1.0
        self._prepared: tuple[list[np.ndarray], TensorDict, TensorDict] | None = None
        self.observations: Observations = Copies(arrays["observation"])

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
        self.observations.begin()

    def _write_defer(self, defer: np.ndarray | None) -> None:
        # Whoever is interrupted here has not forgotten that flags may be set.
        if defer is not None:
            self._deferring = True
            np.not_equal(defer, 0, out=self._defer)
        elif self._deferring:
            self._defer.fill(0)
            self._deferring = False

    def prepare(self) -> None:
        """Do that part of the next :meth:`read` which does not need the frame, while the frame is waited for."""
        if self._prepared is None:
            blanks = [np.empty_like(source) for source in self._sources]
            self._prepared = blanks, *self._assemble([torch.from_numpy(blank) for blank in blanks])

    def take(self, rows: slice) -> None:
        """Take the observations of some environments for the next :meth:`read`: see :class:`Observations`."""
        self.observations.take(rows)

    def read(self, stepped: bool = False) -> tuple[TensorDict, TensorDict]:
        """Return what a step leads to, with the reward, and the same without it: the state to act on next.

        Everything in :func:`~izoo.envs.specs.observation_spec` and the done flags are there. Both share their tensors.

        Args:
            stepped: a step has just ended, and no frame changed since.
        """
        if self._prepared is None:
            following, state = self._assemble([torch.from_numpy(source.copy()) for source in self._sources])
        else:
            blanks, following, state = self._prepared
            self._prepared = None
            for blank, source in zip(blanks, self._sources, strict=True):
                np.copyto(blank, source)
        for frame, observation in zip((following, state), self.observations.read(stepped), strict=True):
            set_entry(frame["agents"], "observation", observation)
        if self.config.emit:
            self._add_groups(following, state)
        return following, state

    def _assemble(self, leaves: Sequence[Tensor]) -> tuple[TensorDict, TensorDict]:
        """Return the two TensorDicts of a step from copies of the sources; observations and groups are to be added."""
        count = len(self._agent_keys)
        agents = dict(zip(self._agent_keys, leaves[:count], strict=True))
        root: dict[str, Tensor | TensorDict] = dict(zip(self._root_keys, leaves[count:], strict=True))
        following = _new({**root, "agents": _new({**agents}, self.agents_batch)}, self.batch)
        del agents["reward"]
        root["agents"] = _new(agents, self.agents_batch)
        return following, _new(root, self.batch)

    def _add_groups(self, following: TensorDict, state: TensorDict) -> None:
        """Add the groups of ``config.emit``, from copies of the blocks of the frames."""
        t, emit = self.tensors, self.config.emit
        groups: dict[str, TensorDict] = {}
        if "reward_vector" in emit:
            following["agents"]["reward_vector"] = state["agents"]["reward_vector"] = t["reward_vector"].clone()
        if "vehicles" in emit:
            groups["vehicles"] = self._vehicles()
        if "signal" in emit:
            signal = {"colour": t["signal_colour"].clone(), "time_left_s": t["signal_time_left_s"].clone()}
            groups["signal"] = _new(signal, torch.Size((*self.batch, self.config.num_approaches)))
        if "context" in emit:
            groups["context"] = self.context()
        if "metrics" in emit:
            groups["metrics"] = self.metrics()
        for name, group in groups.items():
            for tensordict in (following, state):
                set_entry(tensordict, name, group)

    def context(self) -> TensorDict:
        """Read the context group."""
        values, ids = self.tensors["context_values"].clone(), self.tensors["context_ids"].clone()
        columns = dict(zip(CONTEXT_VALUES, values.split(1, -1), strict=True))
        columns |= dict(zip(CONTEXT_IDS, ids.split(1, -1), strict=True))
        return _new(columns, self.batch)

    def _vehicles(self) -> TensorDict:
        t = self.tensors
        columns = dict(zip(VEHICLE_FLOATS, t["vehicle_floats"].clone().unbind(-1), strict=True))
        columns |= dict(zip(VEHICLE_INTS, t["vehicle_ints"].clone().unbind(-1), strict=True))
        columns |= dict(zip(VEHICLE_FLAGS, t["vehicle_flags"].clone().unbind(-1), strict=True))
        if self.vehicle_names is not None:
            columns = {name: columns[name] for name in self.vehicle_names}
        return _new(columns, torch.Size((*self.batch, self.config.num_vehicles)))

    def metrics(self) -> TensorDict:
        """Read the metrics group: sums of the episode so far."""
        approach = dict(zip(APPROACH_METRICS, self.tensors["approach_metrics"].clone().unbind(-1), strict=True))
        approach["mask"] = self.tensors["approach_mask"].clone()
        episode = dict(zip(EPISODE_METRICS, self.tensors["episode_metrics"].clone().split(1, -1), strict=True))
        p = torch.Size((*self.batch, self.config.num_approaches))
        return _new({"approach": _new(approach, p), "episode": _new(episode, self.batch)}, self.batch)


def set_entry(tensordict: TensorDictBase, key: str, value: Any) -> None:
    """Set an entry whose shape is known to be right."""
    tensordict._set_str(key, value, validated=True, inplace=False, non_blocking=False)


def _new(columns: dict[str, Tensor] | dict[str, TensorDict | Tensor], batch: torch.Size) -> TensorDict:
    # The specs' test compares shapes once; checking them in every step would cost more than the copies.
    return TensorDict._new_unsafe(columns, batch_size=batch)
