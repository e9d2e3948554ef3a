"""What steps emit is in memory of its own, whichever threads wrote it, and whatever was there before."""

import contextlib
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from izoo.envs import TwinEnv
from izoo.envs.config import EMIT_GROUPS
from izoo.envs.frame_copies import KEPT, BatchBuffer
from tests.envs.worlds import crossing, short, steer

NUM_ENVS, STEPS, BATCHES = 3, 25, 5
Steps = list[tuple[TensorDict, TensorDict, TensorDict]]


def collect(threads: int, after: Callable[[TwinEnv, int], None], in_place: bool) -> Steps:
    """Return what each step acted on, led to, and left to act on; episodes of 110 steps."""
    found: Steps = []
    config = short(emit=EMIT_GROUPS)
    with contextlib.closing(TwinEnv(NUM_ENVS, crossing(), config=config, threads=threads)) as env:
        if in_place:
            env.reader.outlet = BatchBuffer(env.reader.layout, STEPS)
        env.reset()
        state = env.advance([40, 0, 70])
        for number in range(1, STEPS * BATCHES + 1):
            acted_on = state.clone()
            stepped, state = env.step_and_maybe_reset(steer(state))
            found.append((acted_on, stepped["next"].clone(), state.clone()))
            after(env, number)
    return found


def same(one: TensorDict, other: TensorDict) -> bool:
    return all(torch.equal(one[key], other[key]) for key in other.keys(True, True))


@pytest.mark.parametrize("threads", [1, 2])
def test_a_batch_in_place_holds_what_each_step_would_have_copied(threads: int) -> None:
    batches: list[tuple[TensorDict, TensorDict]] = []

    def keep(env: TwinEnv, number: int) -> None:
        if number % STEPS == 0:
            led_to, acted_on = env.reader.outlet.batch()  # type: ignore[attr-defined]
            size = torch.Size((STEPS, NUM_ENVS))
            batches.append(
                (env.reader.assemble(acted_on, size)[1].clone(), env.reader.assemble(led_to, size)[0].clone())
            )

    placed, copied = collect(threads, keep, True), collect(3 - threads, lambda env, number: None, False)
    begun = sum(
        int((led_to["agents", "observation"] != onward["agents", "observation"]).any((1, 2)).sum())
        for _, led_to, onward in copied
    )
    assert begun == 3
    for one, other in zip(placed, copied, strict=True):
        assert all(same(a, b) for a, b in zip(one, other, strict=True))
    for k, whole in enumerate(zip(*batches, strict=True)):
        assert same(torch.cat(whole), torch.stack([step[k].exclude(("agents", "action")) for step in copied]))


def test_half_a_batch_is_not_handed_over() -> None:
    with contextlib.closing(TwinEnv(1, crossing(), config=short(), threads=1)) as env:
        buffer = env.reader.outlet = BatchBuffer(env.reader.layout, 2)
        env.step(steer(env.reset()))
        with pytest.raises(RuntimeError, match="1 of 2 steps"):
            buffer.batch()


def test_memory_is_used_again_only_when_nobody_holds_it() -> None:
    """A part of a tensor holds the whole, and what is written into one that is let go leaves no trace."""
    with contextlib.closing(TwinEnv(2, crossing(), config=short(), threads=2)) as env:
        state, held = env.reset(), []
        places = set()
        for number in range(30):
            stepped, state = env.step_and_maybe_reset(steer(state))
            observation: Tensor = stepped["next", "agents", "observation"]
            places.add(observation.data_ptr())
            if number % 3 == 0:
                held.append((observation[0, :2], observation[0, :2].clone()))
            empty = ~stepped["next", "agents", "mask"]
            assert (observation[empty] == 0.0).all()
            if number % 3 == 1:
                stepped["next", "agents", "observation"].fill_(7.0)
            del observation, stepped
        assert all(torch.equal(part, copy) for part, copy in held)
        assert len(places) < 30 and len(places) >= len(held)
        assert all(len(pool) <= KEPT for pool in env.reader.outlet._pools)  # type: ignore[attr-defined]
