"""Buffered observations equal the copies that every step would make."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from izoo.envs import TwinEnv
from izoo.envs.observation_buffer import Tape
from tests.envs.worlds import crossing, short, steer

NUM_ENVS, STEPS, BATCHES = 3, 25, 8
Observed = list[tuple[Tensor, Tensor, Tensor]]


def collect(threads: int, after: Callable[[TwinEnv, int], None], buffered: bool) -> Observed:
    """Return the observations that each step acted on, led to, and left to act on; episodes of 110 steps."""
    found: Observed = []
    with contextlib.closing(TwinEnv(NUM_ENVS, crossing(), config=short(), threads=threads)) as env:
        if buffered:
            env.reader.observations = Tape(STEPS, env.frames["observation"], env.frames["mask"])
        env.reset()
        state = env.advance([40, 0, 70])
        for number in range(1, STEPS * BATCHES + 1):
            acted_on = state["agents", "observation"].clone()
            stepped, state = env.step_and_maybe_reset(steer(state))
            found.append(
                (acted_on, stepped["next", "agents", "observation"].clone(), state["agents", "observation"].clone())
            )
            after(env, number)
    return found


@pytest.mark.parametrize("threads", [1, 2])
def test_the_buffer_holds_what_each_step_would_copy(threads: int) -> None:
    batches: list[tuple[Tensor, Tensor]] = []

    def keep(env: TwinEnv, number: int) -> None:
        if number % STEPS == 0:
            acted_on, led_to = env.reader.observations.batch()  # type: ignore[attr-defined]
            batches.append((acted_on.clone(), led_to.clone()))

    taped, copied = collect(threads, keep, True), collect(threads, lambda env, number: None, False)
    begun = sum(int((led_to != onward).any((1, 2)).sum()) for _, led_to, onward in copied)
    assert begun == 5 and max(int((part[0][0].any(-1)).sum()) for part in copied) > 8
    for one, other in zip(taped, copied, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))
    for k, whole in enumerate(zip(*batches, strict=True)):
        parts = zip(*(step[k] for step in copied), strict=True)
        assert torch.equal(torch.cat(whole, 1), torch.stack([torch.stack(part) for part in parts]))
