"""A collector whose rollouts do per step only what izoo's environments and policies need."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs.utils import set_exploration_type

from izoo.algos.base import InPlace
from izoo.envs.recorder import BatchRecorder


class RolloutCollector(Collector):
    """TorchRL's collector with a shorter loop; the batches are the same.

    It expects izoo's environments, a policy that writes into the TensorDict it is given, everything on the CPU, and no
    replay buffer. Frames are copied straight into the batch, whose memory the next batch re-uses; a policy that has a
    method ``in_place`` (:class:`izoo.algos.base.InPlace`) reads and writes there without TensorDicts.
    """

    _recorder: BatchRecorder | None = None

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """Collect ``frames_per_batch`` steps; the batch ``[*B, T]`` is valid until the next call."""
        batch: TensorDictBase = self._final_rollout
        policy, env, recorder = self._wrapped_policy, self.env, self._recorder
        if recorder is None or not recorder.serves(batch):
            recorder = self._recorder = BatchRecorder(env.reader, batch)
        recorder.write_state(0)
        with set_exploration_type(self.exploration_type):
            in_place = isinstance(policy, InPlace)
            act = policy.in_place(recorder.frame, recorder.told) if in_place else recorder.by_calling(policy)
            for step in range(self.frames_per_batch):
                act(step)
                env.step_recorded(recorder, step)
        return batch
