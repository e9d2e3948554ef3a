"""A collector whose rollouts do per step only what izoo's environments and policies need."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, is_tensor_collection
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs.utils import set_exploration_type

Path = tuple[str, ...]


class RolloutCollector(Collector):
    """TorchRL's collector with a shorter loop; the batches are the same.

    It expects a policy that writes into the TensorDict it is given, environments that reset themselves, everything on
    the CPU, and no replay buffer; per step nothing is then left but the policy, the environment and a few appends. The
    batch is stacked at its end, leaf by leaf, into memory that the next batch re-uses.
    """

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """Collect ``frames_per_batch`` steps; the batch ``[*B, T]`` is valid until the next call."""
        batch: TensorDictBase = self._final_rollout
        state: TensorDictBase = self._carrier  # type: ignore[has-type]
        groups: dict[Path, list[dict[str, Any]]] = {path: [] for path in _groups(batch)}
        policy, step = self._wrapped_policy, self.env.step_and_maybe_reset
        with set_exploration_type(self.exploration_type):
            for _ in range(self.frames_per_batch):
                frame, state = step(policy(state))
                for path, rows in groups.items():
                    rows.append(_entries(frame, path))
        self._carrier = state
        for path, rows in groups.items():
            target = batch.get(path) if path else batch
            for key, leaf in target.items():
                if isinstance(leaf, Tensor):
                    torch.stack([row[key] for row in rows], dim=batch.ndim - 1, out=leaf)
        return batch


def _groups(tensordict: TensorDictBase, path: Path = ()) -> list[Path]:
    """Return the paths of a TensorDict and of those in it, but for what the collector itself adds."""
    found = [path]
    for key, value in tensordict.items():
        if is_tensor_collection(value) and (*path, key) != ("collector",):
            found += _groups(value, (*path, key))
    return found


def _entries(frame: TensorDictBase, path: Path) -> dict[str, Any]:
    for key in path:
        frame = frame._get_str(key, None)
    return frame._tensordict if isinstance(frame, TensorDict) else dict(frame.items())
