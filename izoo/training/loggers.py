"""Metrics of a run: ``metrics.csv`` always, Weights & Biases or TensorBoard on request, and the learning curve."""

from __future__ import annotations

import contextlib
import csv
import netrc
import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from izoo.conf.train_options import LoggerConfig
from izoo.errors import IzooError
from izoo.files import reading, replacing

if TYPE_CHECKING:
    from torchrl.record.loggers import Logger

FIRST_COLUMNS = (
    *("frames", "seconds", "frames_per_s", "episodes", "return", "reward"),
    *("emission_g_per_vehicle", "throughput_veh_per_episode"),
)
IMITATION = "loss_imitation"
"""The column of rows in which a policy still imitated (:mod:`izoo.algos.learners.imitation`)."""
SHOWN = (
    ("frames_per_s", "{:.0f} frames/s"),
    ("return", "return {:.1f}"),
    ("emission_g_per_vehicle", "{:.1f} g/veh"),
    ("throughput_veh_per_episode", "{:.0f} veh/episode"),
    ("co2_saved", "{:+.1f} % CO2 saved"),
    (IMITATION, "imitating, loss {:.2f}"),
    ("validation_co2_saved", "validation {:+.1f} %{}"),
    ("validation_delay_change_s", "delay {:+.1f} s{}"),
)
"""Numbers that are shown while a run trains, and how; some with their interval."""
WANDB_HOST = "api.wandb.ai"
LOGGER_FOLDERS = ("wandb", "tensorboard")
"""What loggers write into a run's folder."""


class MetricsTable:
    """The rows of ``metrics.csv``, one per batch; a number that a batch does not have is an empty cell.

    Args:
        path: the file; rows that it already has are kept.
        last_frames: rows beyond this many frames are dropped: a resumed run writes them again.
    """

    def __init__(self, path: Path, last_frames: int = 0) -> None:
        self.path = path
        self.rows = [row for row in _read_rows(path) if int(row["frames"]) <= last_frames]
        self.columns: list[str] = list(self.rows[0]) if self.rows else []
        if self.rows:
            self._rewrite()
        else:
            path.unlink(missing_ok=True)

    @classmethod
    def read(cls, path: Path) -> MetricsTable:
        """Return the table as it lies there, of a run that may be running; no file gives an empty one."""
        table = cls.__new__(cls)
        table.path, table.rows = path, _read_rows(path)
        table.columns = list(table.rows[0]) if table.rows else []
        return table

    def append(self, row: Mapping[str, float]) -> None:
        """Add a row; the file is complete after every call."""
        text = {key: _number(value) for key, value in row.items()}
        self.rows.append(text)
        new = [key for key in row if key not in self.columns]
        if new or not self.path.exists():
            known = {*self.columns, *new}
            first = [key for key in FIRST_COLUMNS if key in known]
            self.columns = [*first, *(key for key in [*self.columns, *new] if key not in first)]
            self._rewrite()
            return
        with self.path.open("a", newline="") as file:
            csv.DictWriter(file, self.columns, restval="").writerow(text)

    def series(self, name: str) -> tuple[list[int], list[float]]:
        """Return frames and values of a column, without the rows that lack it."""
        pairs = [(int(row["frames"]), float(row[name])) for row in self.rows if row.get(name)]
        return [frames for frames, _ in pairs], [value for _, value in pairs]

    def _rewrite(self) -> None:
        with replacing(self.path) as partial, partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, self.columns, restval="")
            writer.writeheader()
            writer.writerows(self.rows)


def _read_rows(path: Path) -> list[dict[str, str]]:
    """Read the rows whose line ends; a last one that was cut short is left out."""
    if not path.exists():
        return []
    with reading(path):
        text = path.read_text()
        rows = list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines(), strict=True))
        for row in rows:
            int(row["frames"])
    return rows


def make_sinks(config: LoggerConfig, run_dir: Path) -> list[Logger]:
    """Return the loggers besides the CSV that ``config`` asks for."""
    if config.name == "csv":
        return []
    os.environ.setdefault("WANDB_SILENT", "true")
    os.environ.setdefault("WANDB_CONSOLE", "off")
    from torchrl.record.loggers import get_logger

    name = run_dir.name if config.name == "wandb" else config.name
    wandb = {"offline": not _has_wandb_key(), "project": config.project}
    try:
        return [get_logger(config.name, str(run_dir), name, wandb_kwargs=wandb)]
    except ImportError as error:
        package = "wandb" if config.name == "wandb" else "'izoo[tensorboard]'"
        raise IzooError(f"logger={config.name} needs a package: pip install {package}.") from error


def in_short(latest: Mapping[str, float]) -> str:
    """Return the numbers of :data:`SHOWN` on one line, without those that ``latest`` lacks."""
    return "  ".join(form.format(latest[name], _interval(latest, name)) for name, form in SHOWN if name in latest)


def _interval(latest: Mapping[str, float], name: str) -> str:
    """Return the interval of a figure, with a blank before it, or nothing where there is none."""
    low, high = (latest.get(f"{name}_{end}") for end in ("low", "high"))
    return "" if low is None or high is None else f" [{low:.1f}, {high:.1f}]"


def log_all(sinks: list[Logger], row: Mapping[str, float]) -> None:
    """Send a row of the table to every logger; one that fails is done without from then on."""
    for sink in list(sinks):
        with _dispensable(sink, sinks):
            for name, value in row.items():
                if name != "frames":
                    sink.log_scalar(name, value, step=int(row["frames"]))


def close_all(sinks: list[Logger]) -> None:
    """Let the loggers finish writing."""
    for sink in list(sinks):
        with _dispensable(sink, sinks):
            experiment: Any = getattr(sink, "experiment", None)
            finish = getattr(experiment, "finish", None) or getattr(experiment, "close", None)
            if finish is not None:
                finish()


@contextlib.contextmanager
def _dispensable(sink: Logger, sinks: list[Logger]) -> Iterator[None]:
    """Go on without a logger that fails: everything is in ``metrics.csv`` as well."""
    try:
        yield
    except Exception as error:  # what a logger raises is its own
        sinks.remove(sink)
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        print(f"{type(sink).__name__} has failed ({reason}); the run goes on without it.", file=sys.stderr, flush=True)


def _has_wandb_key() -> bool:
    if os.environ.get("WANDB_MODE") in ("offline", "disabled"):
        return False
    if os.environ.get("WANDB_API_KEY"):
        return True
    try:
        return netrc.netrc().authenticators(WANDB_HOST) is not None
    except (OSError, netrc.NetrcParseError):
        return False


def _number(value: float) -> str:
    return str(int(value)) if float(value).is_integer() and abs(value) < 1e15 else f"{value:.7g}"
