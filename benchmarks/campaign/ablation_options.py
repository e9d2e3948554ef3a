"""Options of ``python -m izoo.benchmarks.ablation``, and the rows that it compares."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from izoo.conf.recipes import BUSY_LANE, ONCE
from izoo.errors import IzooError, check_range, check_types, unknown_choice
from izoo.files import expanded

ALL = "all"
SETTING = (
    *BUSY_LANE,
    "num_envs=64",
    "num_workers=1",
    *ONCE,
    "algo=ppo",
    "algo.epochs=6",
    "algo.lr=5e-3",
    "algo.activation=relu",
    "algo.separate_clips=true",
    "algo.max_grad_norm=1",
    "validation.contexts=48",
    "validation.seeds=1",
    "validation.simulator=twin",
    "evaluation.contexts=0",
    "checkpoint.every_batches=5",
    "checkpoint.keep=1",
    "twin.compare_every=0",
)
"""What all rows share: PPO chooses desired speeds on the approaches of ``recipe=busy_lane``."""
_PER_VEHICLE = ("total_frames=61440", "algo.frames_per_batch=1536", "validation.every_batches=8")
_PER_STEP = ("env.decide=step", "total_frames=163840", "algo.frames_per_batch=4096", "validation.every_batches=8")
SCOPES = {
    "per_vehicle": ("a vehicle decides once", _PER_VEHICLE),
    "every_8_s": ("every 8 s", ("env.hold_s=8", "algo.gamma=0.97", *_PER_STEP)),
    "every_2_s": ("every 2 s", ("env.hold_s=2", *_PER_STEP)),
    "every_half_s": ("every 0.5 s", ("env.hold_s=0.5", "algo.gamma=0.998", *_PER_STEP)),
}
"""When a CV decides. Deciding in steps makes more than ten times as many decisions."""
BASELINES = {
    "paired": ("the same vehicle uncommanded", ("algo.control_variate=vehicle",)),
    "learned": ("a learned value", ()),
    # A critic that is not learned, and small beside the returns.
    "none": ("no baseline", ("algo.value_coeff=0", "algo.gae_lambda=1", "algo.reward_scale=100")),
}
"""What is taken from a vehicle's return."""
REWARDS = {
    "own": ("paid for itself and those behind it", ("env.reward=fuel",)),
    "team": ("paid for the whole team", ("env.reward=fuel_team",)),
}
REFERENCE = "per_vehicle-paired-own"
"""The row that the others are compared with."""


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        label: in words.
        words: options of ``izoo.train`` beside :data:`SETTING`; the last of several that set the same one counts.
    """

    label: str
    words: tuple[str, ...]


def _row(*parts: tuple[str, tuple[str, ...]]) -> Row:
    return Row(", ".join(label for label, _ in parts), tuple(word for _, words in parts for word in words))


ROWS = {
    "-".join(names): _row(SCOPES[names[0]], BASELINES[names[1]], REWARDS[names[2]])
    for names in itertools.product(SCOPES, BASELINES, REWARDS)
}
"""What is trained, by name: every scope with every baseline and every reward."""


@dataclass(frozen=True)
class AblationConfig:
    """Options of the ablation.

    Attributes:
        rows: names of the rows; ``all`` stands for every one.
        train: further options of ``izoo.train`` for all rows, such as ``total_frames``.
        seeds: training seeds of every row, from 0 on.
        num_contexts: contexts that every policy is compared in, which none was trained on.
        eval_seeds: paired episodes per context.
        horizon_s: length of these.
        threads: of the twin; null: one per core.
        out: folder of the runs and of the result; what is done in it already is not done again.
        verbose: print all figures of every row, and all differences.
    """

    rows: tuple[str, ...] = (ALL,)
    train: tuple[str, ...] = ()
    seeds: int = 4
    num_contexts: int = 64
    eval_seeds: int = 1
    horizon_s: float = 1000.0
    threads: int | None = None
    out: str = "ablation"
    verbose: bool = False

    def __post_init__(self) -> None:
        check_types("", self)
        for name in self.rows:
            if name not in (*ROWS, ALL):
                raise unknown_choice("rows", name, (ALL, *ROWS))
        if not self.rows:
            raise IzooError("rows is empty; name some, or give rows=[all].")
        check_range("seeds", self.seeds, 1, 1000)
        check_range("num_contexts", self.num_contexts, 1, 10**6)
        check_range("eval_seeds", self.eval_seeds, 1, 10**6)
        if self.threads is not None:
            check_range("threads", self.threads, 1, 1024)
        object.__setattr__(self, "out", str(expanded(self.out).absolute()))

    @property
    def chosen(self) -> tuple[str, ...]:
        """The names of the rows that are trained, in the order of the table, with the one they are compared with."""
        wanted = set(ROWS) if ALL in self.rows else {REFERENCE, *self.rows}
        return tuple(name for name in ROWS if name in wanted)
