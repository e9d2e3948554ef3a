"""Scripted drivers write what an environment reads."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from izoo.algos.scripted import RandomDriver, UncommandedDriver


def make_step(n: int = 2, a: int = 3) -> TensorDict:
    return TensorDict({"agents": TensorDict({"mask": torch.ones(n, a, dtype=torch.bool)}, [n, a])}, [n])


def test_random_driver_covers_the_range_and_repeats_with_its_seed() -> None:
    one = torch.cat([RandomDriver(-4.5, 2.6, seed=4)(make_step(50, 40))["agents", "action"]])
    other = RandomDriver(-4.5, 2.6, seed=4)(make_step(50, 40))["agents", "action"]
    assert one.shape == (50, 40, 1)
    torch.testing.assert_close(one, other)
    assert -4.5 <= float(one.min()) < -4.3 and 2.4 < float(one.max()) <= 2.6
    assert not torch.equal(one, RandomDriver(-4.5, 2.6, seed=5)(make_step(50, 40))["agents", "action"])


def test_uncommanded_driver_defers_everyone() -> None:
    step = UncommandedDriver()(make_step())
    assert bool(step["agents", "defer"].all())
    assert step["agents", "action"].shape == (2, 3, 1)
