"""Environments as the training loop needs them: an episode's metrics travel as one leaf, :data:`TOTALS`.

Metrics matter once per episode, but every leaf of a step costs time in each of TorchRL's passes over it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from izoo.envs.env import EcoDrivingBase, EcoDrivingEnv, SumoParallelEnv
from izoo.envs.mdp.frame import TOTALS
from izoo.metrics.definitions import APPROACH_METRICS, EPISODE_METRICS
from izoo.training import past


class _Training(EcoDrivingBase):
    """Adds :data:`TOTALS` to what an environment emits, and plays episodes in progress up to where they stood.

    Args:
        pasts: one per environment; the first reset plays them up to where they stood. None: episodes begin anew.
    """

    leaves = (TOTALS,)

    def __init__(self, *args: Any, pasts: Sequence[past.EpisodePast] = (), **options: Any) -> None:
        super().__init__(*args, **options)
        self._pasts = tuple(pasts)
        self.observation_spec[TOTALS] = Unbounded(self.reader.tensors[TOTALS].shape)

    def _reset(self, tensordict: TensorDictBase | None = None, **options: Any) -> TensorDictBase:
        pasts, self._pasts = self._pasts, ()
        return self._relive(pasts) if pasts else super()._reset(tensordict, **options)

    def _relive(self, pasts: Sequence[past.EpisodePast]) -> TensorDictBase:
        """Play episodes up to where they stood; all get there at the same time.

        Before the shorter ones begin, their environments play a part of the same episode that is then forgotten.
        """
        slots = self.config.num_agents
        scripts = [entry.unroll(slots) for entry in pasts]
        names = next((list(script.commands) for script in scripts if script.commands), ["action"])
        episodes = torch.tensor([script.episode for script in scripts]).view(*self.batch_size, 1)
        longest = max(len(script) for script in scripts)
        request = TensorDict({"context": TensorDict({"episode": episodes}, self.batch_size)}, self.batch_size)
        frame = super()._reset(request)
        for step in range(longest):
            starting = torch.tensor([len(script) == longest - step for script in scripts])
            if step > 0 and starting.any():
                frame = super()._reset(request.clone().set("_reset", starting.view(*self.batch_size, 1)))
            masks = frame.get(("agents", "mask")).view(-1, slots)
            waits = [longest - len(script) for script in scripts]
            rows = [
                script.at(step - wait, mask) if step >= wait else past.idle(names, slots)
                for script, wait, mask in zip(scripts, waits, masks, strict=True)
            ]
            frame = self._step(past.with_commands(frame, rows)).exclude(("agents", "reward"))
            if frame.get("done").any():
                raise RuntimeError("a simulation was lost while its episode was played again; resume the run once more")
        # A script without steps belongs to an episode that was about to begin.
        unbegun = torch.tensor([len(script) == 0 for script in scripts])
        if longest > 0 and unbegun.any():
            frame = super()._reset(request.clone().set("_reset", unbegun.view(*self.batch_size, 1)))
        self._next_episode[:] = [script.episode + self._stride for script in scripts]
        return frame


class TrainingEnv(_Training, EcoDrivingEnv):
    """:class:`~izoo.envs.EcoDrivingEnv` with :data:`TOTALS` and pasts."""


class TrainingParallelEnv(_Training, SumoParallelEnv):
    """:class:`~izoo.envs.SumoParallelEnv` with :data:`TOTALS` and pasts."""


def split_totals(totals: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return per-episode metrics ``[n]`` and per-approach metrics ``[n, P]``, by name, of ``totals [n, E + P * M]``."""
    episode = totals[:, : len(EPISODE_METRICS)].unbind(-1)
    approach = totals[:, len(EPISODE_METRICS) :].unflatten(-1, (-1, len(APPROACH_METRICS))).unbind(-1)
    return dict(zip(EPISODE_METRICS, episode, strict=True)), dict(zip(APPROACH_METRICS, approach, strict=True))
