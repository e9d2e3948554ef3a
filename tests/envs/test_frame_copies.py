"""What steps emit is in memory of its own, whichever threads wrote it, and whatever was there before."""

import contextlib

import torch
from torch import Tensor

from izoo.envs import TwinEnv
from izoo.envs.frame_copies import KEPT
from tests.envs.worlds import crossing, short, steer


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
