"""Schedules that are made of another one: of a resumed run, and of policies that are compared."""

from __future__ import annotations

from dataclasses import dataclass

from izoo.contexts.context import Context
from izoo.contexts.source import Schedule


@dataclass(frozen=True)
class ShiftedSchedule:
    """``schedule`` from its episode number ``first`` on: what a resumed run has not played yet."""

    schedule: Schedule
    first: int

    def __call__(self, episode: int) -> tuple[Context, int]:
        return self.schedule(self.first + episode)


@dataclass(frozen=True)
class SharedSchedule:
    """``schedule`` for environments in ``blocks`` of equal size, all of which play the same episodes.

    Attributes:
        schedule: the episodes of one block.
        envs: environments in all, a multiple of ``blocks``.
        blocks: how many policies are compared.
    """

    schedule: Schedule
    envs: int
    blocks: int

    def __call__(self, episode: int) -> tuple[Context, int]:
        size = self.envs // self.blocks
        return self.schedule(episode // self.envs * size + episode % size)
