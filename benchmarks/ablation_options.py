"""Options of ``python -m izoo.benchmarks.ablation``, and the rows that it compares."""

from __future__ import annotations

from dataclasses import dataclass

from izoo.conf.recipes import BUSY_LANE
from izoo.errors import IzooError, check_range, check_types, unknown_choice
from izoo.files import expanded

ALL = "all"
SETTING = (
    *BUSY_LANE,
    "num_envs=32",
    "env.horizon_s=400",
    "total_frames=52800",
    "num_workers=1",
    "evaluation.contexts=0",
    "validation.every_batches=0",
    "checkpoint.every_batches=4",
    "checkpoint.keep=1",
    "twin.compare_every=0",
)
"""What all rows share: the approaches of ``recipe=busy_lane`` and 52,800 decisions of 2 s, in episodes of 400 s."""
PPO = (
    "algo.warm_start=glide",
    "algo.warm_start_frames=4800",
    "algo.warm_start_lr=1e-3",
    "algo.frames_per_batch=4800",
    "algo.rows_per_epoch=16384",
    "algo.minibatch_rows=1024",
    "algo.epochs=3",
    "algo.activation=relu",
    "algo.lr=1e-3",
    "algo.separate_clips=true",
    "algo.max_grad_norm=2",
    "algo.value_norm=running",
    "algo.target_kl=0.015",
    "algo.kl_to_start=0.3",
)
IMITATION = (
    "algo=ppo",
    *PPO,
    "env.reward=fuel_team",
    "algo.warm_start_frames=52800",
    "algo.warm_start_lr=2e-3",
    "algo.minibatch_rows=512",
    "algo.epochs=6",
)
WHOLE = ("algo=mappo", *PPO, "env.reward=fuel_team", "algo.credit=team", "algo.control_variate=true")
"""MAPPO with every part; the rows below take one away or change it."""
REPLAY = (
    "env.reward=fuel",
    "algo.frames_per_batch=1920",
    "algo.updates_per_frame=0.05",
    "algo.learning_starts=3840",
    "algo.n_step=5",
    "algo.rows_per_frame=4",
)
HOLD_1, HOLD_4 = ("env.hold_s=1", "algo.gamma=0.995"), ("env.hold_s=4", "algo.gamma=0.98")
"""Decisions of other lengths, which look as far ahead."""
START, REFERENCE = "imitation", "whole"
"""The row with whose policies most others begin, and the one that they are compared with."""


def _frames(factor: float) -> tuple[str, ...]:
    """Return the options of the same simulated time in ``factor`` times as many decisions."""
    of = {"total_frames": 52800, "algo.warm_start_frames": 4800, "algo.frames_per_batch": 4800}
    return tuple(f"{name}={round(factor * value)}" for name, value in of.items())


def _all_imitated(factor: float) -> tuple[str, ...]:
    """Return :func:`_frames`, all of them of the imitation."""
    return (*_frames(factor), f"algo.warm_start_frames={round(factor * 52800)}")


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        label: in words.
        words: options of ``izoo.train`` beside :data:`SETTING`; the last of several that set the same one counts.
        start: the row with whose policies, of the same seeds, it begins; ``None``: with untrained ones.
    """

    label: str
    words: tuple[str, ...]
    start: str | None = START


ROWS = {
    START: Row("imitation of glide alone", IMITATION, start=None),
    REFERENCE: Row("then MAPPO with all parts", WHOLE),
    "no_kl": Row("no penalty on leaving the imitation", (*WHOLE, "algo.kl_to_start=0")),
    "agent_credit": Row("credit by agent, same reward", (*WHOLE, "algo.control_variate=false", "algo.credit=agent")),
    "no_control_variate": Row("no control variate", (*WHOLE, "algo.control_variate=false")),
    "prioritised": Row("prioritised level replay", (*WHOLE, "levels.draw=prioritised", "levels.kept=64")),
    "no_value_norm": Row("values not normalised", (*WHOLE, "algo.value_norm=none")),
    "no_target_kl": Row("no bound on an update's divergence", (*WHOLE, "algo.target_kl=null")),
    "in_step": Row("episodes begin together", (*WHOLE, "twin.stagger=false")),
    "critic_sees_all": Row("the critic sees every vehicle", (*WHOLE, "algo.critic_sees=all")),
    f"{START}_hold_1": Row("imitation, decisions of 1 s", (*IMITATION, *HOLD_1, *_all_imitated(2.0)), start=None),
    "hold_1": Row("then decisions of 1 s", (*WHOLE, *HOLD_1, *_frames(2.0)), start=f"{START}_hold_1"),
    f"{START}_hold_4": Row("imitation, decisions of 4 s", (*IMITATION, *HOLD_4, *_all_imitated(0.5)), start=None),
    "hold_4": Row("then decisions of 4 s", (*WHOLE, *HOLD_4, *_frames(0.5)), start=f"{START}_hold_4"),
    "ppo_own_fuel": Row("PPO, paid for itself and those behind it", ("algo=ppo", *PPO, "env.reward=fuel")),
    "no_imitation": Row("MAPPO with all parts, from scratch", (*WHOLE, "algo.warm_start=none"), start=None),
    "td3": Row("TD3 from scratch, applied advice stored", ("algo=td3", *REPLAY), start=None),
    "td3_commanded": Row(
        "TD3 from scratch, given advice stored", ("algo=td3", *REPLAY, "algo.stores=commanded"), start=None
    ),
    "ddpg": Row("DDPG from scratch, given advice stored", ("algo=ddpg", *REPLAY), start=None),
    "ddpg_applied": Row(
        "DDPG from scratch, applied advice stored", ("algo=ddpg", *REPLAY, "algo.stores=applied"), start=None
    ),
}
"""What is trained, by name, in the order of the table."""


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
    num_contexts: int = 16
    eval_seeds: int = 3
    horizon_s: float = 600.0
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
        """The names of the rows that are trained, in the order of the table, with those that others rest on."""
        wanted = set(ROWS) if ALL in self.rows else {START, REFERENCE, *self.rows}
        wanted |= {start for name in wanted if (start := ROWS[name].start) is not None}
        return tuple(name for name in ROWS if name in wanted)
