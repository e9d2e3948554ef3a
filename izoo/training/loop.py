"""A training run from its options to its last table: a new one, or one that is resumed."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from izoo.conf.train_options import CHANGEABLE, TrainConfig
from izoo.errors import IzooError, UnfinishedError
from izoo.files import NO_ROOM
from izoo.training import checkpoint, run_folder
from izoo.training.learner import learner_device
from izoo.training.option_checks import check_options
from izoo.training.run_state import RunState
from izoo.training.session import Session, Show, last_good


def train(config: TrainConfig, show: Show | None = None) -> Path:
    """Train as ``config`` says and return the run folder.

    Args:
        config: the options; of a run that is resumed, those of :func:`izoo.training.run_folder.resumed`.
        show: called with the summary of the final evaluation; ``None`` prints its verdict.

    Raises:
        IzooError: the options, or the run that is resumed, cannot be used; a new run leaves nothing behind.
        UnfinishedError: the run cannot go on: the disk or the memory is full, or its numbers are not finite any more;
            the message names the last good checkpoint.
        KeyboardInterrupt: after Ctrl-C or SIGTERM, once the run is saved.
    """
    if config.resume is not None:
        run_dir, path = run_folder.resume_point(Path(config.resume))
        with run_folder.owned(run_dir), _room(run_dir):
            state = _to_resume(config, run_dir, path)
            run = RunState(config, config.contexts.build())
            if path is None or state is None:
                run.begin()
            else:
                run.restore(state, path)
                print(f"Resuming {run_dir} at {run.frames:,} frames.", flush=True)
            Session(run, run_dir).run(show)
        return run_dir
    # Contexts are read before the folder is made, so that bad input leaves nothing behind.
    learner_device(config.device)
    check_options(config)
    source = config.contexts.build()
    with run_folder.created(config) as run_dir, _room(run_dir):
        run = RunState(config, source)
        run.begin()
        Session(run, run_dir).run(show)
    return run_dir


@contextlib.contextmanager
def _room(run_dir: Path) -> Iterator[None]:
    """Say in one sentence that the disk is full, or that memory is short.

    Raises:
        UnfinishedError: so it is.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in NO_ROOM and not str(error.filename).startswith(str(run_dir)):
            raise
        raise UnfinishedError(f"cannot write to {run_dir}: {error.strerror}. {last_good(run_dir)}") from error
    except (MemoryError, RuntimeError) as error:
        text = (str(error).splitlines() or ["out of memory"])[0]
        if isinstance(error, RuntimeError) and "allocate" not in text:  # torch has many errors for it
            raise
        remedy = "give fewer rows, smaller networks or fewer agents"
        raise UnfinishedError(f"the memory does not suffice ({text}); {remedy}.") from error


def _to_resume(config: TrainConfig, run_dir: Path, path: Path | None) -> dict[str, Any] | None:
    """Check and write the options with which a run goes on, and return the state of its checkpoint."""
    stored = run_folder.read_config(run_dir)
    run_folder.check_drivers(run_dir, stored)
    for name in (field.name for field in dataclasses.fields(config)):
        if name not in (*CHANGEABLE, "run_dir") and getattr(config, name) != getattr(stored, name):
            raise IzooError(
                f"{name} differs from that of {run_dir}; a resumed run keeps its own options "
                "(izoo.training.run_folder.resumed returns them)."
            )
    state = None if path is None else checkpoint.load(path)
    # The last batch of a run that is done may have gone beyond its frames.
    if state is not None and config.total_frames < min(stored.total_frames, state["frames"]):
        raise IzooError(
            f"{path} has {state['frames']:,} frames already, more than total_frames={config.total_frames}; give more, "
            "or leave total_frames out."
        )
    learner_device(config.device)
    check_options(config)
    run_folder.write_config(run_dir, config)
    return state
