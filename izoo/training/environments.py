"""Environments as the training loop needs them: an episode's metrics travel as one leaf.

Metrics matter once per episode, but every leaf of a step costs time in each of TorchRL's passes over it.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from izoo.envs.env import EcoDrivingBase, EcoDrivingEnv
from izoo.envs.parallel import SumoParallelEnv
from izoo.metrics.definitions import APPROACH_METRICS, EPISODE_METRICS

TOTALS = "totals"
"""Key of the leaf ``[*B, E + P * M]``: the episode's metrics, then those of each approach."""


class _Totals(EcoDrivingBase):
    """Adds :data:`TOTALS` to what an environment emits."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        width = sum(math.prod(part.shape[len(self.batch_size) :]) for part in self._parts())
        self.observation_spec[TOTALS] = Unbounded((*self.batch_size, width))

    def _parts(self) -> tuple[Tensor, Tensor]:
        tensors = self.reader.tensors
        return tensors["episode_metrics"], tensors["approach_metrics"].flatten(len(self.batch_size))

    def _add_totals(self, frame: TensorDictBase) -> TensorDictBase:
        return frame.set(TOTALS, torch.cat(self._parts(), dim=-1))

    def _next_frame(self) -> TensorDict:
        return self._add_totals(super()._next_frame())

    def _first_frame(self) -> TensorDict:
        return self._add_totals(super()._first_frame())


class TrainingEnv(_Totals, EcoDrivingEnv):
    """:class:`~izoo.envs.EcoDrivingEnv` with :data:`TOTALS`."""


class TrainingParallelEnv(_Totals, SumoParallelEnv):
    """:class:`~izoo.envs.SumoParallelEnv` with :data:`TOTALS`."""


def split_totals(totals: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return per-episode metrics ``[n]`` and per-approach metrics ``[n, P]``, by name, of ``totals [n, E + P * M]``."""
    episode = totals[:, : len(EPISODE_METRICS)].unbind(-1)
    approach = totals[:, len(EPISODE_METRICS) :].unflatten(-1, (-1, len(APPROACH_METRICS))).unbind(-1)
    return dict(zip(EPISODE_METRICS, episode, strict=True)), dict(zip(APPROACH_METRICS, approach, strict=True))
