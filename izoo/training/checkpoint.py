"""Checkpoints that are either whole or absent: written under another name, flushed to the disk, then renamed."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from izoo.errors import IzooError
from izoo.files import check_parts, reading, replacing

FORMAT = "izoo-checkpoint-4"
_NAME = re.compile(r"(?:step|candidate)-(\d+)\.pt")
BEST = "best.pt"


def folder_of(run_dir: Path) -> Path:
    """Return the folder that holds a run's checkpoints."""
    return run_dir / "checkpoints"


def save(run_dir: Path, frames: int, state: dict[str, Any], keep: int, abandoned: Sequence[Path] = ()) -> Path:
    """Write ``checkpoints/step-<frames>.pt``, then remove all but the ``keep`` newest.

    Args:
        run_dir: the run.
        frames: environment steps so far; orders the checkpoints.
        state: tensors, numbers, strings and containers of them.
        keep: at least 1.
        abandoned: later checkpoints of a run that was resumed further back, which go then, too.

    Raises:
        OSError: the disk is full or not writable; other checkpoints are untouched.
    """
    folder = folder_of(run_dir)
    folder.mkdir(exist_ok=True)  # without its parents: a run folder that was removed must not come back half empty
    path = folder / f"step-{frames:012d}.pt"
    import torch

    try:
        with replacing(path) as partial:
            torch.save({"format": FORMAT, "frames": frames, **state}, partial)
    except RuntimeError as error:  # of torch, where a write fails
        raise OSError(errno.EIO, "it was not written whole; is the disk full?", str(path)) from error
    remove(old for old in abandoned if old != path)
    remove(listed(run_dir)[:-keep])
    return path


def remove(paths: Iterable[Path]) -> None:
    """Remove checkpoints, if they are there."""
    for path in paths:
        path.unlink(missing_ok=True)


def listed(run_dir: Path) -> list[Path]:
    """Return a run's checkpoints, oldest first."""
    return sorted(folder_of(run_dir).glob("step-*.pt"))


def load(path: Path) -> dict[str, Any]:
    """Read one checkpoint file.

    Raises:
        IzooError: the file is missing, damaged, or not a checkpoint of this version of izoo.
    """
    import torch

    with reading(path):
        check_parts(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
        if state["format"] != FORMAT:
            raise ValueError(f"it is not of format {FORMAT}")
    return state


def find(where: Path, which: str = "last") -> Path:
    """Return the checkpoint that ``where`` names: a checkpoint file, or one of a run folder.

    Args:
        where: the file or the folder.
        which: of a folder: ``last``, ``best`` (by validation), or the number of frames.

    Raises:
        IzooError: nothing is there, or a file and one of a folder are named at the same time.
    """
    if where.is_file():
        if which != "last":
            raise IzooError(f"{where} is one checkpoint, so checkpoint={which} chooses nothing; leave it out.")
        if where.parent.name != folder_of(where).name:
            raise IzooError(
                f"{where} is a file that does not lie among a run's checkpoints; give the folder of a training run."
            )
        return where
    if not where.is_dir():
        raise IzooError(f"{where} does not exist; give the folder of a training run.")
    found = {str(frames_of(path)): path for path in listed(where)}
    best = best_of(where)
    named = found | ({} if best is None else {"best": best})
    if not named:
        raise IzooError(f"{where} holds no checkpoint; give the folder of a training run that has saved at least one.")
    named["last"] = listed(where)[-1] if found else named["best"]
    if which not in named:
        raise IzooError(
            f"checkpoint is {which!r}; {where} has {', '.join(named)} (best comes with validation.every_batches)."
        )
    return named[which]


def best_of(run_dir: Path) -> Path | None:
    """Return a run's best checkpoint, if it has validated any."""
    path = folder_of(run_dir) / BEST
    return path if path.is_file() else None


def make_candidate(path: Path) -> Path:
    """Keep a checkpoint for validation, however many later ones are saved meanwhile; it takes no space."""
    candidate = path.with_name(path.name.replace("step-", "candidate-"))
    candidate.unlink(missing_ok=True)
    try:
        os.link(path, candidate)
    except OSError:  # a file system without links
        shutil.copyfile(path, candidate)
    return candidate


def make_best(candidate: Path) -> None:
    """Make a candidate the best checkpoint of its run."""
    candidate.replace(candidate.with_name(BEST))


def candidates(run_dir: Path) -> list[Path]:
    """Return the checkpoints whose validation has not ended, oldest first."""
    return sorted(folder_of(run_dir).glob("candidate-*.pt"))


def frames_of(path: Path) -> int:
    """Return the environment steps that a checkpoint was saved after."""
    named = _NAME.fullmatch(path.name)
    return int(named[1]) if named else int(load(path)["frames"])


def run_of(checkpoint: Path) -> Path:
    """Return the run folder that a checkpoint file belongs to."""
    return checkpoint.parent.parent
