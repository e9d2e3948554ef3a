"""What nodes send of their batches, and how it becomes one batch; a cluster is in test_ray.py."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from izoo.algos.learners.base import MASK, OBSERVATION, REWARD
from izoo.training.twin_nodes import Assembly, pack

N, T, A, F = 3, 4, 5, 2


def played(seed: int) -> TensorDictBase:
    """A batch of a node, steps first in memory, with 0 where no agent is."""
    draw = np.random.default_rng(seed)
    mask, following = (draw.random((T, N, A)) < 0.4 for _ in range(2))
    leaves: dict[str | tuple[str, ...], np.ndarray] = {
        MASK: mask,
        ("next", *MASK): following,
        OBSERVATION: draw.random((T, N, A, F), np.float32) * mask[..., None],
        ("next", *OBSERVATION): draw.random((T, N, A, F), np.float32) * following[..., None],
        ("next", *REWARD): draw.random((T, N, A, 1), np.float32) * mask[..., None],
        ("next", "done"): draw.random((T, N, 1)) < 0.1,
    }
    batch = TensorDict({key: torch.from_numpy(leaf) for key, leaf in leaves.items()}, [T, N])
    for group in ("agents", ("next", "agents")):
        batch.get(group).batch_size = torch.Size([T, N, A])
    return batch.transpose(0, 1)


def test_parts_in_any_order_make_the_batch_of_all_nodes() -> None:
    assembly = Assembly(2)
    for seed in (0, 10):  # the second one is written over the first
        parts = [played(seed), played(seed + 1)]
        whole = assembly.batch((node, pack(parts[node])) for node in (1, 0))
        assert whole.shape == (2 * N, T) and whole.get("agents").shape == (2 * N, T, A)
        for key, leaf in torch.cat(parts).items(True, True):
            torch.testing.assert_close(whole.get(key), leaf, rtol=0.0, atol=0.0)


@pytest.mark.parametrize("nodes", [1, 2])
def test_empty_slots_and_other_leaves_are_not_sent(nodes: int) -> None:
    part = pack(played(0), (MASK, ("next", *REWARD)))
    assert set(part.leaves) == {MASK, ("next", *REWARD)}
    assert len(part.held) == len(part.leaves[MASK]) < N * T * A
    whole = Assembly(nodes).batch((node, part) for node in range(nodes))
    assert int(whole.get(MASK).sum()) == nodes * int(played(0).get(MASK).sum())
