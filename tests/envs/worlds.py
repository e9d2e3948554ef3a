"""Contexts, drivers and helpers that the tests of the environments share."""

import dataclasses
import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from izoo.contexts.context import Context
from izoo.contexts.procedural import procedural_context
from izoo.envs import EnvConfig, SumoParallelEnv
from izoo.envs.env import EcoDrivingBase
from tests.networks.worlds import with_approaches

Driver = Callable[[TensorDictBase], TensorDictBase]


def crossing(**changes: Any) -> Context:
    """A busy little intersection: two lanes and lefts on all four legs of 100 m, half of the vehicles controlled."""
    values = {
        "lane_count": 2,
        "phase_count": 2,
        "inflow_vph_per_lane": 600.0,
        "lane_length_m": 100.0,
        "approach": "all",
        "adoption": 0.5,
        "offset_s": 2.0,
    }
    return procedural_context(**(values | changes))


def one_lane(**changes: Any) -> Context:
    """An approach of one lane from leg A, on which the twin drives exactly as SUMO does."""
    values = {"lane_count": 1, "phase_count": 1, "approach": "A", "inflow_vph_per_lane": 500.0, "offset_s": 2.0}
    return procedural_context(**(values | changes))


def cramped(lanes: int = 4, road_m: float = 40.0, source_m: float = 10.0) -> Context:
    """Legs and sources too short for the lane changes that some vehicles need, and to stop at a red light."""
    context = crossing(lane_count=lanes, lane_length_m=60.0)
    spec = with_approaches(context.intersection, "ABCD", length_m=road_m)
    ghosts = dataclasses.replace(spec.ghosts, straight_source_length_m=source_m, turning_source_length_m=source_m)
    return context.replace(intersection=dataclasses.replace(spec, name="cramped", source="osm", ghosts=ghosts))


def short(**changes: Any) -> EnvConfig:
    """Settings of an episode of 55 s after 5 s of warm-up."""
    return EnvConfig(**({"horizon_s": 60.0, "warmup_s": 5.0} | changes))


def set_action(tensordict: TensorDictBase, action: torch.Tensor) -> TensorDictBase:
    return tensordict.set(("agents", "action"), action)


def constant(value: float, parts: int = 1) -> Driver:
    """The same action for every CV."""
    return lambda state: set_action(state, torch.full((*state["agents", "mask"].shape, parts), value))


def defer(tensordict: TensorDictBase) -> TensorDictBase:
    """Leave every CV uncommanded."""
    mask = tensordict["agents", "mask"]
    tensordict["agents", "defer"] = torch.ones_like(mask)
    return set_action(tensordict, torch.zeros(*mask.shape, 1))


def steering(observation: torch.Tensor) -> torch.Tensor:
    """A fixed function from observations ``[*B, A, F]`` to accelerations ``[*B, A, 1]``."""
    weights = torch.sin(torch.arange(observation.shape[-1]) * 1.7)
    # Rounded, so that the order of a sum does not matter.
    action = 3.0 * torch.tanh(torch.round((observation * weights).sum(-1), decimals=3)) - 0.2
    return action.clamp(-4.5, 2.6).unsqueeze(-1)


def choose_lanes(observation: torch.Tensor) -> torch.Tensor:
    """A fixed function from observations ``[*B, A, F]`` to lane changes ``[*B, A]``, each of the three now and then."""
    return (torch.round(observation[..., 1] * 250.0).long() // 7) % 3


def steer_and_change(tensordict: TensorDictBase) -> TensorDictBase:
    """Command acceleration and lane of every CV with fixed functions of what it observes."""
    tensordict["agents", "lane_change"] = choose_lanes(tensordict["agents", "observation"])
    return steer(tensordict)


def steer(tensordict: TensorDictBase) -> TensorDictBase:
    """Command every CV with a fixed function of what it observes."""
    return set_action(tensordict, steering(tensordict["agents", "observation"]))


def at_random(seed: int) -> Driver:
    """Return a driver with random actions over the whole range."""
    generator = torch.Generator().manual_seed(seed)

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        shape = (*tensordict["agents", "mask"].shape, 1)
        return set_action(tensordict, torch.rand(shape, generator=generator) * 7.1 - 4.5)

    return act


def play(env: EcoDrivingBase, steps: int, act: Driver = steer, start: TensorDictBase | None = None) -> TensorDict:
    """Return ``steps`` steps, stacked in the last batch dimension; episodes that end begin anew."""
    return play_on(env, steps, act, env.reset() if start is None else start)[0]


def play_on(env: EcoDrivingBase, steps: int, act: Driver, state: TensorDictBase) -> tuple[TensorDict, TensorDictBase]:
    """Return ``steps`` steps from ``state``, and the state after them."""
    frames = []
    for _ in range(steps):
        frame, state = env.step_and_maybe_reset(act(state))
        frames.append(frame)
    return torch.stack(frames, -1), state


def episode(env: EcoDrivingBase, act: Driver = steer) -> TensorDict:
    """Return one whole episode."""
    return play(env, env.config.control_steps, act)


def digest(frames: TensorDictBase) -> str:
    """Hash steps ``[T]``: positions, speeds, observations, rewards, and the final counts."""
    result = hashlib.sha256()
    for part in (frames, frames["next"]):
        vehicles = part["vehicles"]
        for name in ("vehicle_number", "region_lane", "lane_position_m", "speed_mps", "emission_g"):
            _feed(result, vehicles[name][vehicles["present"]])
        _feed(result, part["agents", "mask"])
        _feed(result, part["agents", "observation"])
    _feed(result, frames["next", "agents", "reward"])
    for group in ("approach", "episode"):
        for _, value in sorted(frames["next", "metrics", group].items()):
            _feed(result, value)
    return result.hexdigest()[:16]


def _feed(result: Any, value: torch.Tensor) -> None:
    # Three decimals: the compiled kernels may differ in the last bits from one kind of processor to another.
    array = np.round(value.numpy().astype(np.float64), 3) + 0.0
    result.update(array.tobytes())


def same(one: TensorDictBase, other: TensorDictBase) -> bool:
    """Whether two TensorDicts hold the same keys and numbers."""
    return bool((one == other).all())


def places(vehicles: TensorDictBase) -> dict[int, tuple[float, float]]:
    """Path position and speed of every vehicle by its number."""
    columns = (vehicles[n][vehicles["present"]].tolist() for n in ("vehicle_number", "path_position_m", "speed_mps"))
    return {number: (position, speed) for number, position, speed in zip(*columns, strict=True)}


def process_of(env: SumoParallelEnv, index: int) -> int:
    """Return the process number of a worker."""
    worker = env.backend._workers[index]
    assert worker is not None
    return worker.process.pid
