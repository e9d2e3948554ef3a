"""What tells one policy from another."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase

from izoo.algos.scripted import Glide, GlideConfig
from izoo.envs.config import EnvConfig
from izoo.evaluation.fingerprint import fingerprint


class Setting(TensorDictModuleBase):
    """A driver with a number that is no parameter."""

    in_keys, out_keys = ["a"], ["b"]

    def __init__(self, speed_mps: float) -> None:
        super().__init__()
        self.speed_mps = speed_mps


def test_a_module_with_another_setting_is_another_policy() -> None:
    assert fingerprint(Setting(5.0)) == fingerprint(Setting(5.0)) != fingerprint(Setting(12.0))
    config = EnvConfig()
    glides = [Glide(config), Glide(config), Glide(config, GlideConfig(floor_mps=2.0))]
    one, same, other = (fingerprint(glide) for glide in glides)
    assert one == same != other


def driving(speed_mps: float, *more: Any) -> Any:
    def act(tensordict: Any) -> Any:
        return speed_mps, more

    return act


class Held:
    """A callable with something of its own."""

    def __init__(self, held: Any) -> None:
        self.held = held

    def __call__(self, tensordict: Any) -> Any:
        return self.held


@pytest.mark.parametrize(
    ("make", "one", "other"),
    [
        (driving, 1.0, 2.0),
        (Held, 1.0, 2.0),
        (Held, {"a": [1], "b": {2, 3}}, {"a": [1], "b": {2, 4}}),
        (Held, Setting(1.0), Setting(2.0)),
        (lambda speed: functools.partial(driving, speed), 1.0, 2.0),
        (lambda speed: functools.partial(driving, more=speed), 1.0, 2.0),
        (lambda speed: functools.partial(driving(speed)), 1.0, 2.0),
        (lambda speed: TensorDictModule(driving(speed), in_keys=["a"], out_keys=["b"]), 1.0, 2.0),
        (lambda speed: TensorDictModule(Held(speed), in_keys=["a"], out_keys=["b"]), 1.0, 2.0),
        (lambda speed: Held(speed).__call__, 1.0, 2.0),
        (lambda speed: Held(Held(speed)), 1.0, 2.0),
        (lambda speed: Held(driving(speed)), 1.0, 2.0),
        (lambda middle: Held(np.array([0.0] * 2000 + [middle] + [0.0] * 2000)), 1.0, 2.0),
        (lambda speed: Held(torch.tensor(speed)), 1.0, 1.000001),
        (lambda speed: Held(torch.tensor(speed, dtype=torch.bfloat16)), 1.0, 2.0),
        (lambda seed: Held(np.random.default_rng(seed)), 1, 2),
        (lambda seed: Held(torch.Generator().manual_seed(seed)), 1, 2),
    ],
)
def test_a_callable_with_another_state_is_another_policy(make: Any, one: Any, other: Any) -> None:
    assert fingerprint(make(one)) == fingerprint(make(one)) != fingerprint(make(other))


def test_a_callable_may_hold_itself_or_nothing_yet() -> None:
    held = Held([1.0])
    held.held.append(held)

    def unfilled() -> Any:
        return later

    if not held.held:
        later = 1.0
    assert fingerprint(held) and fingerprint(unfilled)


@pytest.mark.slow
def test_fingerprints_are_the_same_in_every_process() -> None:
    code = (
        "import numpy as np, torch; from izoo import zoo; from izoo.evaluation.fingerprint import fingerprint;"
        "from tests.evaluation.test_fingerprint import Held;"
        "print(fingerprint(Held([np.random.default_rng(1), {'a', 'b', 'c'}, object()])),"
        "fingerprint(zoo.load('salt_lake_city_ddpg').policy))"
    )
    found = []
    for seed in ("1", "2"):
        env = {**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": os.pathsep.join(sys.path)}
        found.append(subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, check=True).stdout)
    assert found[0] == found[1] and len(found[0].split()) == 2
