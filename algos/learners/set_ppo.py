"""PPO whose minibatches are whole frames, for networks in which agents interact
(:mod:`izoo.algos.networks.set_networks`)."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from tensordict import TensorDict

from izoo.algos.learners.ppo import PPO
from izoo.algos.networks.set_networks import FRAME


class SetPPO(PPO):
    """PPO whose networks may look at all agents of a frame at once; minibatches consist of whole frames.

    Networks are :class:`~izoo.algos.networks.set_networks.RowView` s that read
    :data:`~izoo.algos.networks.set_networks.FRAME` and
    :data:`~izoo.algos.networks.set_networks.COLUMN` beside the observation, or modules that read the mask.
    """

    looks_around = True
    """Its networks see the other agents of a frame: :class:`izoo.algos.learners.decisions.Decisions` keeps whole
    frames."""

    def _minibatches(self, rows: TensorDict) -> Iterator[TensorDict]:
        """Yield rows of whole frames: about ``rows_per_epoch`` of them per epoch, ``minibatch_rows`` at a time."""
        frame = rows.get(FRAME)
        count = int(frame[-1]) + 1
        agents_per_frame = len(rows) / count
        limit = max(round((self.config.rows_per_epoch or len(rows)) / agents_per_frame), 1)
        size = max(round(self.config.minibatch_rows / agents_per_frame), 1)
        for _ in range(self.config.epochs):
            order = torch.randperm(count, device=frame.device)[:limit]
            rank = torch.full_like(frame, count)[:count]
            rank[order] = torch.arange(len(order), device=frame.device)
            ranks, index = rank[frame].sort(stable=True)
            starts = torch.arange(0, len(order) + size, size, device=frame.device).clamp(max=len(order))
            cuts = torch.searchsorted(ranks, starts).tolist()
            for first, begin, end in zip(starts.tolist()[:-1], cuts[:-1], cuts[1:], strict=True):
                part = rows[index[begin:end]]
                yield part.set(FRAME, ranks[begin:end] - first)
