"""Policies that evaluation must survive, importable by worker processes."""

from __future__ import annotations

import os
import random
import signal
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase


def gentle(tensordict: TensorDictBase) -> TensorDictBase:
    """Everybody accelerates at 0.5 m/s^2."""
    return everyone(tensordict, 0.5)


def leftwards(tensordict: TensorDictBase) -> TensorDictBase:
    """As ``gentle``, and always one lane to the left."""
    mask = tensordict["agents", "mask"]
    return gentle(tensordict).set(("agents", "lane_change"), torch.full(mask.shape, 2))


def broken(tensordict: TensorDictBase) -> TensorDictBase:
    """Raises as soon as it is asked."""
    raise ArithmeticError("the driver fell asleep")


def silent(tensordict: TensorDictBase) -> TensorDictBase:
    """Writes no action."""
    return tensordict


def deadly(tensordict: TensorDictBase) -> TensorDictBase:
    """Kills its process."""
    os.kill(os.getpid(), signal.SIGKILL)
    return tensordict


def everyone(tensordict: TensorDictBase, accel_mps2: float) -> TensorDictBase:
    """Every CV gets one acceleration."""
    mask = tensordict["agents", "mask"]
    return tensordict.set(("agents", "action"), torch.full((*mask.shape, 1), accel_mps2))


class Tiring:
    """Drives the slower, the more steps it has made."""

    def __init__(self) -> None:
        self.steps = 0

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.steps += 1
        return everyone(tensordict, 1.0 - 0.01 * self.steps)


class Remembering:
    """As :class:`Tiring`, but keeps its memory in the TensorDict."""

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        steps = tensordict.get("steps", torch.zeros(1)) + 1
        return everyone(tensordict, 1.0 - 0.01 * float(steps)).set("steps", steps)


class Drawing:
    """Draws from a generator of its own."""

    def __init__(self) -> None:
        self.generator = np.random.default_rng(0)

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        return everyone(tensordict, self.generator.uniform(-1.0, 1.0))


class Numpy:
    """Draws from numpy's default generator, and from Python's."""

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        return everyone(tensordict, np.random.uniform(-1.0, 0.5) + random.random())  # noqa: NPY002


class Recurrent:
    """Keeps a count under ``"next"``, as TorchRL's recurrent modules do, and notes what it found."""

    seen: ClassVar[list[tuple[bool, float | None]]] = []

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        count = tensordict.get("count", None)
        Recurrent.seen.append((bool(tensordict["is_init"]), None if count is None else float(count)))
        tensordict.set(("next", "count"), torch.ones(1) if count is None else count + 1)
        return gentle(tensordict)


class Moody(torch.nn.Module):
    """:func:`gentle`, but while it trains."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return everyone(tensordict, -1.0 if self.training else 0.5)


class Bound:
    """:func:`gentle`, once it knows the environments."""

    def bind(self, env: object) -> Bound:
        self.env = env
        return self

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        assert self.env.batch_size == tensordict.batch_size
        return gentle(tensordict)


class Counted:
    """:func:`gentle`, leaving a line in a file for every step; from ``fail_at`` on it raises instead."""

    def __init__(self, path: Path, fail_at: int = 10**9) -> None:
        self.path, self.limit = path, path.with_suffix(".limit")
        self.limit.write_text(str(fail_at))

    def steps(self) -> int:
        return len(self.path.read_text().splitlines()) if self.path.exists() else 0

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.steps() >= int(self.limit.read_text()):
            raise ArithmeticError("out of luck")
        with self.path.open("a") as file:
            file.write("step\n")
        return gentle(tensordict)
