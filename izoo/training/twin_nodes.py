"""Batches from twins on the nodes of a Ray cluster: each steps environments of its own and acts for them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from izoo.algos.learners.base import MASK, Keys
from izoo.results import ray_cluster
from izoo.training.batches_in_place import BatchesInPlace
from izoo.training.environments import TrainingBatchEnv


class Packed(NamedTuple):
    """A batch ``[N, T]`` without the slots that hold no agent in a step or after it.

    Attributes:
        shape: ``(T, N, A)``.
        held: places of the other ``n`` slots in ``[T * N * A]``.
        leaves: by key; those of agents ``[n, ...]``, others ``[T, N, ...]``.
    """

    shape: tuple[int, ...]
    held: np.ndarray
    leaves: dict[str | tuple[str, ...], np.ndarray]


def pack(batch: TensorDictBase, keys: Keys | None = None) -> Packed:
    """Return what is sent of a batch ``[N, T]``.

    Args:
        batch: as :class:`~izoo.training.batches_in_place.BatchesInPlace` makes it.
        keys: leaves that are sent; ``None``: all.
    """
    steps = batch.transpose(0, 1)
    there = steps.get(MASK) | steps.get(("next", *MASK))
    held = there.flatten().nonzero().squeeze(-1)
    leaves = (steps if keys is None else steps.select(*keys)).items(True, True)
    rows = {key: leaf.flatten(0, 2).index_select(0, held) if "agents" in key else leaf for key, leaf in leaves}
    return Packed(tuple(there.shape), held.numpy(), {key: leaf.numpy() for key, leaf in rows.items()})


class Assembly:
    """Memory for a batch ``[nodes * N, T]``, into which nodes' parts are written; slots without an agent are 0.

    Memory from the system would have to be cleared for every batch, which takes four times as long.
    """

    def __init__(self, nodes: int) -> None:
        self._nodes = nodes
        self._leaves: dict[Any, np.ndarray] = {}
        self._written: dict[int, np.ndarray] = {}

    def batch(self, parts: Iterable[tuple[int, Packed]]) -> TensorDictBase:
        """Return the batch of what each node, by its number, sends; it is valid until the next one."""
        for node, (shape, held, leaves) in parts:
            steps, envs, slots = shape
            step, of_step = np.divmod(held, envs * slots)
            places = (step * self._nodes + node) * (envs * slots) + of_step
            for key, leaf in leaves.items():
                size = (steps, self._nodes * envs)
                if "agents" in key:
                    whole = self._leaf(key, (*size, slots, *leaf.shape[1:]), leaf).reshape(-1, *leaf.shape[1:])
                    whole[self._written.get(node, places)] = 0
                    whole[places] = leaf
                else:
                    self._leaf(key, (*size, *leaf.shape[2:]), leaf)[:, node * envs : (node + 1) * envs] = leaf
            self._written[node] = places
        batch = TensorDict({key: torch.from_numpy(whole) for key, whole in self._leaves.items()}, size)
        for group in ("agents", ("next", "agents")):
            batch.get(group).batch_size = torch.Size((*size, slots))
        return batch.transpose(0, 1)

    def _leaf(self, key: Any, shape: tuple[int, ...], template: np.ndarray) -> np.ndarray:
        if key not in self._leaves:
            self._leaves[key] = np.zeros(shape, template.dtype)
        return self._leaves[key]


class _Node:
    """Environments and a policy, in a process of the cluster."""

    def __init__(
        self,
        make_env: Callable[[], TrainingBatchEnv],
        policy: TensorDictModuleBase,
        steps: int,
        keys: Keys | None,
        seed: int,
    ) -> None:
        torch.set_num_threads(1)
        torch.manual_seed(seed)  # of what the policy draws
        self._policy, self._keys = policy, keys
        self._batches = BatchesInPlace(make_env(), policy, steps)

    def next(self, weights: dict[str, Any]) -> Packed:
        """Return the next batch, which a policy with these weights acts in."""
        self._policy.load_state_dict(weights)
        return pack(self._batches.next(), self._keys)


class TwinNodes:
    """Endless batches ``[nodes * N, T]``, in which the policy acts as it is when :meth:`next` is called.

    Args:
        makers: each returns the ``N`` environments of a node, and is called there.
        policy: what acts, on a CPU.
        steps: ``T``.
        cores: what each node asks of the cluster.
        keys: leaves that the batches have; ``None``: all.
    """

    def __init__(
        self,
        makers: Sequence[Callable[[], TrainingBatchEnv]],
        policy: TensorDictModuleBase,
        steps: int,
        cores: int = 1,
        keys: Keys | None = None,
    ) -> None:
        self._ray, self._policy = ray_cluster.connect(), policy
        make = self._ray.remote(num_cpus=cores, num_gpus=0)(_Node).remote
        self._nodes = [make(make_env, policy, steps, keys, seed) for seed, make_env in enumerate(makers)]
        self._assembly = Assembly(len(makers))

    def next(self) -> TensorDictBase:
        """Return the next batch, valid until the one after it; the nodes' parts are put into place as they come."""
        return self._assembly.batch(self._arriving())

    def _arriving(self) -> Iterator[tuple[int, Packed]]:
        weights = self._ray.put(self._policy.state_dict())
        waiting = {node.next.remote(weights): number for number, node in enumerate(self._nodes)}
        while waiting:
            (done,), _ = self._ray.wait(list(waiting), num_returns=1)
            yield waiting.pop(done), self._ray.get(done)

    def close(self) -> None:
        """End the nodes' processes."""
        for node in self._nodes:
            self._ray.kill(node)
