"""Periodic validation: while training goes on, another process (:mod:`izoo.training.validation_worker`) plays the run's
weights and the baselines.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from izoo.conf.built_in import CityContexts
from izoo.conf.context_choices import ContextsConfig, MixedContexts
from izoo.conf.folders import DatasetContexts, OsmContexts
from izoo.conf.train_options import TrainConfig
from izoo.contexts.source import ContextSource, MixedSource
from izoo.errors import IzooError
from izoo.metrics.figures import FIGURES, HEADLINE
from izoo.metrics.pairing import HUMAN, UNCOMMANDED, pair
from izoo.metrics.statistics import SIGNIFICANCE, fall_p_value
from izoo.processes import start_process
from izoo.results.selection import EpisodeSeeds, choose_contexts
from izoo.training import checkpoint
from izoo.training.loggers import MetricsTable

if TYPE_CHECKING:
    import pandas as pd

VALIDATION_FILE, RESULT_FOLDER, LOG_FILE = "validation.csv", "validation", "validation.log"
VALIDATION_SEED = 7_561
"""Seed of the validation contexts and episodes, whatever the run's own: runs are compared on the same episodes."""
POLICY, CONTEXTS = "policy", "contexts_saved"
LOGGED = tuple(f"{name}{end}" for name in (*HEADLINE, "co2_saved_over_human") for end in ("", "_low", "_high"))
"""Columns that go into the run's own table as well, as ``validation_NAME``."""
_PATIENCE_S = 0.2


class Validator:
    """Validates checkpoints one after the other in a process of its own, and keeps the best.

    Args:
        config: options of the run.
        run_dir: its folder.
        frames: frames of the run so far; results of later ones are forgotten, an unfinished validation is repeated.
    """

    def __init__(self, config: TrainConfig, run_dir: Path, frames: int = 0) -> None:
        self.options, self.run_dir = config.validation, run_dir
        self.table = MetricsTable(run_dir / VALIDATION_FILE, frames)
        self._process: subprocess.Popen[bytes] | None = None
        self._log: IO[bytes] | None = None
        self._waiting: Path | None = None
        self._validating = Path()
        best = checkpoint.best_of(run_dir)
        if best is not None and checkpoint.frames_of(best) > frames:
            best.unlink()
        judged = dict(zip(*self.table.series("best"), strict=True))
        for candidate in checkpoint.candidates(run_dir):
            number = checkpoint.frames_of(candidate)
            if judged.get(number):  # the run was killed before it could take the place of the best
                checkpoint.make_best(candidate)
            elif self.options.every_batches and number <= frames and number not in judged:
                self._wait_for_turn(candidate)
            else:
                candidate.unlink()

    def due(self, batches: int) -> bool:
        """Whether the weights after this many batches are to be validated."""
        return self.options.every_batches > 0 and batches % self.options.every_batches == 0

    def submit(self, path: Path) -> None:
        """Validate a checkpoint as soon as the process is free; it takes the place of another that still waits."""
        if self._process is not None and checkpoint.frames_of(self._validating) == checkpoint.frames_of(path):
            return  # it is being validated
        self._wait_for_turn(checkpoint.make_candidate(path))
        self._begin()

    def poll(self) -> dict[str, float]:
        """Return what a validation that has just ended says, for the run's own table; empty where none has."""
        if self._process is None or self._process.poll() is None:
            self._begin()
            return {}
        code, self._process = self._process.returncode, None
        self._close_log()
        result = _read_result(self._result(self._validating))
        if code != 0 or result is None:
            self._validating.unlink(missing_ok=True)
            print(
                f"The validation of {self._validating.name} failed ({_last_line(self.run_dir / LOG_FILE, code)}); "
                f"training goes on. See {self.run_dir / LOG_FILE}.",
                file=sys.stderr,
                flush=True,
            )
            self._begin()
            return {}
        contexts = result.pop(CONTEXTS, None)
        row = {name: value for name, value in result.items() if value is not None}
        row["best"] = float(self._is_best(row, contexts))
        self.table.append(row)
        if row["best"]:
            checkpoint.make_best(self._validating)
        else:
            self._validating.unlink(missing_ok=True)
        self._begin()
        logged = {f"validation_{name}": row[name] for name in LOGGED if name in row}
        return {"validation_frames": row["frames"], **logged}

    @property
    def busy(self) -> bool:
        """Whether a validation runs or waits for its turn."""
        return self._process is not None or self._waiting is not None

    def wait(self, stop: Any) -> dict[str, float]:
        """Wait for all validations, until ``stop.requested``; return what the last one says."""
        row: dict[str, float] = {}
        while self.busy and not stop.requested:
            row = self.poll() or row
            time.sleep(_PATIENCE_S)
        return row

    def close(self) -> None:
        """Stop the process; a resumed run validates the same weights again."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None
        self._close_log()

    def _wait_for_turn(self, candidate: Path) -> None:
        if self._waiting is not None and self._waiting != candidate:
            self._waiting.unlink(missing_ok=True)
        self._waiting = candidate

    def _begin(self) -> None:
        if self._process is not None or self._waiting is None:
            return
        self._validating, self._waiting = self._waiting, None
        result = self._result(self._validating)
        result.parent.mkdir(exist_ok=True)
        self._log = (self.run_dir / LOG_FILE).open("wb")
        self._alive, child = socket.socketpair()  # which closes for the process when the run is gone
        with child:
            paths = f"{str(self._validating)!r}, {str(result)!r}"
            call = f"from izoo.training.validation_worker import main; main({child.fileno()}, {paths})"
            self._process = start_process(call, child.fileno(), output=self._log)

    def _result(self, candidate: Path) -> Path:
        return self._result_of(checkpoint.frames_of(candidate))

    def _result_of(self, frames: int) -> Path:
        return self.run_dir / RESULT_FOLDER / f"step-{frames:012d}.json"

    def _is_best(self, row: dict[str, float], contexts: dict[str, Any] | None = None) -> bool:
        """Whether weights take the place of the best: they are not shown to be slower than uncommanded CVs, nor to save
        less CO2 than the weights that save most without being slower. The first ones are the best until then.

        Args:
            row: of the table.
            contexts: intersection and CO2 saved by context; without them, the figure over all of them decides.
        """
        if "co2_saved" not in row or row.get("nan_share"):  # the simulator drove those whose action was NaN
            return False
        saved, slower = (dict(zip(*self.table.series(name), strict=True)) for name in ("co2_saved", "slower"))
        if checkpoint.best_of(self.run_dir) is None or not saved:
            return True  # a run that was resumed further back forgets a later best
        if row.get("slower"):
            return False
        earlier = {frames: value for frames, value in saved.items() if not slower.get(frames)}
        if not earlier:
            return True
        highest = max(earlier, key=lambda frames: (earlier[frames], frames))
        before = _read_result(self._result_of(highest)) or {}
        if not contexts or not before.get(CONTEXTS):
            return row["co2_saved"] >= earlier[highest]
        return not shown_worse(contexts, before[CONTEXTS], len(earlier))

    def _close_log(self) -> None:
        if self._log is not None:
            self._log.close()
            self._log = None


def shown_worse(new: dict[str, Any], old: dict[str, Any], chosen_of: int) -> bool:
    """Whether new weights save less CO2 than old ones, by a paired t-test over intersections.

    The highest of many results is high by luck too. So the significance is shared out among all that the old weights
    were chosen from (Bonferroni): where all of them and the new ones are equally good, the new ones are taken for worse
    in one run of twenty at most.

    Args:
        new, old: intersection and CO2 saved by context.
        chosen_of: the old weights are the best of so many.
    """
    shared = [key for key in new if key in old]
    if not shared:
        return False
    difference = [new[key][1] - old[key][1] for key in shared]
    return fall_p_value(difference, [new[key][0] for key in shared]) < SIGNIFICANCE / max(chosen_of, 1)


def held_out(config: ContextsConfig) -> ContextSource:
    """Return what to validate on: the validation split, or, of contexts without splits, the same distribution."""
    if isinstance(config, MixedContexts):
        return MixedSource([held_out(source) for source in config.sources])
    if isinstance(config, (CityContexts, DatasetContexts, OsmContexts)) and config.split in ("train", "all"):
        with contextlib.suppress(IzooError):  # sets of a few intersections are for training alone
            return dataclasses.replace(config, split="validation").build()
    return config.build()


def validate(path: Path) -> dict[str, Any]:
    """Play a checkpoint's policy and the baselines in the validation contexts; return a row of the table.

    Figures of :data:`~izoo.metrics.figures.HEADLINE`, of the unsaturated contexts if there are any: those that compare
    do so with uncommanded CVs, and ``NAME_low`` and ``NAME_high`` are the ends of their intervals over intersections
    (``None`` where there are too few for one). ``co2_saved_over_human`` compares with human driving. ``slower``: 1
    where the delay is shown to be higher than that of uncommanded CVs. Under :data:`CONTEXTS`: the intersection and the
    CO2 saved of every context.
    """
    from izoo.results import evaluate_policy, summarise
    from izoo.training import run_folder

    started = time.perf_counter()
    algorithm, config, state = run_folder.load_algorithm(path)
    run_folder.check_drivers(checkpoint.run_of(path), config)
    options = config.validation
    table = evaluate_policy(
        algorithm.policy.eval(),
        choose_contexts(held_out(config.contexts), options.contexts, VALIDATION_SEED),
        EpisodeSeeds(VALIDATION_SEED, options.seeds),
        config.env,
        name=POLICY,
        simulator=options.simulator,
        workers=0,
        progress=False,
    )
    summary = summarise(table)
    entry, block = summary["entries"][POLICY], summary["block"]
    beside, human = (entry["against"][baseline][block] for baseline in (UNCOMMANDED, HUMAN))
    figures = {**beside["figures"], "co2_saved_over_human": human["figures"]["co2_saved"]}
    ends = {"": "value", "_low": "low", "_high": "high"}
    compared = {f"{name}{end}": found[part] for name, found in figures.items() for end, part in ends.items()}
    return {
        "frames": state["frames"],
        **compared,
        **{name: entry["levels"][block][name] for name in HEADLINE if name not in figures},
        "slower": float(entry["slower"]),
        "nan_share": entry["levels"]["all"]["nan_share"],
        "intersections": beside["intersections"],
        "seconds": time.perf_counter() - started,
        CONTEXTS: saved_by_context(table, block),
    }


def saved_by_context(table: pd.DataFrame, block: str) -> dict[str, list[Any]]:
    """Return intersection and CO2 saved over uncommanded CVs (per cent) by context, of a block of contexts."""
    contexts, own, baseline = pair(table, POLICY, UNCOMMANDED)
    values = FIGURES["co2_saved"].value(own, baseline)
    return {
        row.context_hash: [row.intersection, float(value)]
        for row, value in zip(contexts.itertuples(), values, strict=True)
        if block == "all" or row.saturated == (block == "saturated")
    }


def _read_result(path: Path) -> dict[str, Any] | None:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None


def _last_line(log: Path, code: int) -> str:
    with contextlib.suppress(OSError):
        lines = log.read_text(errors="replace").strip().splitlines()
        if lines:
            return lines[-1]
    return f"exit code {code}"
