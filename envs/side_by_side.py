"""Several intersections side by side as one TorchRL environment, on whichever simulator."""

from __future__ import annotations

from typing import Any

from izoo.envs import Simulator
from izoo.envs.backend import Backend
from izoo.envs.config import EnvConfig, checked_config
from izoo.envs.env import Contexts, EcoDrivingBase, numbering
from izoo.envs.sumo.workers import SumoWorkers
from izoo.errors import IzooError


class SideBySideEnv(EcoDrivingBase):
    """``N`` intersections that a backend plays side by side; batch size ``[N]``.

    Args:
        num_envs: ``N``.
        contexts, config, seed: as for :class:`~izoo.envs.env.EcoDrivingEnv`; the environments share the schedule.
        shard, num_shards: where several such environments share the schedule, as in TorchRL's ``ParallelEnv``, which of
            how many this is.
        options: of the simulator's backend.
    """

    simulator: Simulator

    def __init__(
        self,
        num_envs: int = 2,
        contexts: Contexts | None = None,
        *,
        config: EnvConfig | None = None,
        seed: int = 0,
        shard: int | None = None,
        num_shards: int = 1,
        **options: Any,
    ) -> None:
        config = checked_config(config)
        numbers = numbering(shard, num_shards, num_envs, seed)
        backend = self.make_backend(config, num_envs, **options)
        super().__init__(contexts, config, seed, [num_envs], backend, *numbers)
        self.num_envs = num_envs

    def make_backend(self, config: EnvConfig, num_envs: int, **options: Any) -> Backend:
        """Return what simulates."""
        return self.simulator.make_backend(config, num_envs, **options)


class SumoParallelEnv(SideBySideEnv):
    """``N`` intersections on SUMO, each simulated by a process of its own; see :class:`SideBySideEnv`.

    It does what TorchRL's ``ParallelEnv`` does, by other means: workers write their frames into shared arrays, and a
    worker that dies or hangs is replaced alone: its step is reported as truncated, with the observation it last had,
    and the others do not notice. Workers start at the first reset.

    Args:
        num_workers: ``N``.
        contexts, options: as for :class:`SideBySideEnv`.
    """

    backend: SumoWorkers

    def __init__(self, num_workers: int = 2, contexts: Contexts | None = None, **options: Any) -> None:
        super().__init__(num_workers, contexts, **options)
        self.num_workers = num_workers

    def make_backend(self, config: EnvConfig, num_envs: int, **options: Any) -> SumoWorkers:
        if config.gui:
            raise IzooError("env.gui works with one environment only; use EcoDrivingEnv (collector=single).")
        return SumoWorkers(config, num_envs, **options)

    @property
    def restarts(self) -> int:
        """How many workers were replaced because they were lost."""
        return self.backend.restarts
