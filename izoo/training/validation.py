"""Periodic validation: beside training, another process (:mod:`izoo.training.validation_rollout`) plays the weights."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from pathlib import Path
from typing import Any

from izoo.conf.train_options import TrainConfig
from izoo.metrics.figures import HEADLINE
from izoo.metrics.statistics import SIGNIFICANCE, fall_p_value
from izoo.processes import ChildProcess
from izoo.training import checkpoint
from izoo.training.loggers import MetricsTable
from izoo.training.validation_rollout import CONTEXTS

VALIDATION_FILE, RESULT_FOLDER, LOG_FILE = "validation.csv", "validation", "validation.log"
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
        self._child: ChildProcess | None = None
        self._waiting: Path | None = None
        self._validating = Path()
        best = checkpoint.best_of(run_dir)
        if best is not None and checkpoint.frames_of(best) > frames:
            best.unlink()
        for candidate in checkpoint.candidates(run_dir):
            if self.options.every_batches and checkpoint.frames_of(candidate) <= frames:
                self._wait_for_turn(candidate)
            else:
                candidate.unlink()

    def due(self, batches: int) -> bool:
        """Whether the weights after this many batches are to be validated."""
        return self.options.every_batches > 0 and batches % self.options.every_batches == 0

    def submit(self, path: Path) -> None:
        """Validate a checkpoint as soon as the process is free; it takes the place of another that still waits."""
        if self._child is not None and checkpoint.frames_of(self._validating) == checkpoint.frames_of(path):
            return  # it is being validated
        self._wait_for_turn(checkpoint.make_candidate(path))
        self._begin()

    def poll(self) -> dict[str, float]:
        """Return what a validation that has just ended says, for the run's own table; empty where none has."""
        if self._child is None or self._child.process.poll() is None:
            self._begin()
            return {}
        code = self._child.process.returncode
        self.close()
        result = _read_result(self._result_of(checkpoint.frames_of(self._validating)))
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
        return self._child is not None or self._waiting is not None

    def wait(self, stop: Any) -> dict[str, float]:
        """Wait for all validations, until ``stop.requested``; return what the last one says."""
        row: dict[str, float] = {}
        while self.busy and not stop.requested:
            row = self.poll() or row
            time.sleep(_PATIENCE_S)
        return row

    def close(self) -> None:
        """Stop the process; a resumed run validates the same weights again."""
        if self._child is not None:
            self._child.kill()
            self._child = None

    def _wait_for_turn(self, candidate: Path) -> None:
        if self._waiting is not None and self._waiting != candidate:
            self._waiting.unlink(missing_ok=True)
        self._waiting = candidate

    def _begin(self) -> None:
        if self._child is not None or self._waiting is None:
            return
        self._validating, self._waiting = self._waiting, None
        result = self._result_of(checkpoint.frames_of(self._validating))
        result.parent.mkdir(exist_ok=True)
        with (self.run_dir / LOG_FILE).open("wb") as log:
            place = "izoo.training.validation_rollout:main"
            self._child = ChildProcess(place, str(self._validating), str(result), output=log)

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
