"""The registry of figures: each number that izoo shows, declared once.

A figure is computed from *sums* of :mod:`izoo.envs.mdp.metric_sums`, of a policy and of a baseline. Console, Markdown,
HTML, JSON, plots and leaderboard files read :data:`FIGURES`; so does training, whose sums are tensors. A new figure is
an entry here (and, if it needs a new sum, one in that module).

A mean over nothing is NaN in tables, and 0 with ``valid`` false in tensors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
Frame = Mapping[str, Any]
"""Sums by name, ``[N]`` each, such as a table of pandas: a row per context, added over approaches, mean over seeds."""
Better = Literal["higher", "lower", "neither"]


@dataclass(frozen=True)
class Ratio:
    """A level: ``scale * (sum of top - sum of minus) / sum of bottom``, or the numerator alone without ``bottom``.

    Attributes:
        top, bottom, minus: names of sums, separated by spaces.
        scale: 100 for per cent.
    """

    top: str
    bottom: str = ""
    minus: str = ""
    scale: float = 1.0

    def __call__(self, own: Frame, baseline: Frame | None = None) -> Array:
        """Return the level of each row of ``own``, ``[N]``; the baseline does not matter."""
        top = self.scale * (_added(own, self.top) - _added(own, self.minus))
        if not self.bottom:
            return top
        bottom = _added(own, self.bottom)
        return np.divide(top, bottom, out=np.full_like(top, np.nan), where=bottom > 0.0)

    def of_tensors(self, sums: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return value (not scaled: shares are fractions) and validity, ``[*B]`` each, of float sums ``[*B]``."""
        top = sum(sums[name] for name in self.top.split()) - sum(sums[name] for name in self.minus.split())
        assert isinstance(top, Tensor)
        if not self.bottom:
            return top, torch.ones_like(top, dtype=torch.bool)
        bottom = torch.stack([sums[name] for name in self.bottom.split()]).sum(0)
        valid = bottom > 0
        return torch.where(valid, top / torch.where(valid, bottom, torch.ones_like(bottom)), 0.0), valid


@dataclass(frozen=True)
class Figure:
    """A number that is shown.

    Attributes:
        name: its key in summaries and files.
        label: what tables call it.
        unit: as shown; figures in ``%`` are in per cent already.
        digits: shown behind the decimal point.
        better: which way is better.
        value: ``(policy's sums, baseline's sums) -> [N]``, one value per context.
        paired: it compares with a baseline; otherwise it is a level of the policy alone.
    """

    name: str
    label: str
    unit: str
    digits: int
    better: Better
    value: Callable[[Frame, Frame], Array]
    paired: bool = False


def share(top: str, bottom: str, minus: str = "") -> Ratio:
    """Return a :class:`Ratio` in per cent."""
    return Ratio(top, bottom, minus, scale=100.0)


CO2_G = Ratio("cohort_region_co2_g cohort_blocked_co2_g", "cohort")
DELAY_S = Ratio("cohort_region_delay_s cohort_blocked_s", "cohort")


def co2_saved(own: Frame, baseline: Frame) -> Array:
    """Per cent of the baseline's CO2 per vehicle of the cohort that the policy saves; NaN where that burns none."""
    burned, other = CO2_G(own), CO2_G(baseline)
    return 100.0 * (1.0 - np.divide(burned, other, out=np.full_like(burned, np.nan), where=other > 0.0))


def delay_change_s(own: Frame, baseline: Frame) -> Array:
    """Seconds of delay per vehicle of the cohort that the policy adds to the baseline's."""
    return DELAY_S(own) - DELAY_S(baseline)


FIGURES: dict[str, Figure] = {
    figure.name: figure
    for figure in (
        Figure("co2_saved", "CO2 saved", "%", 1, "higher", co2_saved, paired=True),
        Figure("delay_change_s", "delay added", "s", 1, "lower", delay_change_s, paired=True),
        Figure("co2_g", "CO2 per vehicle", "g", 1, "lower", CO2_G),
        Figure("delay_s", "delay per vehicle", "s", 1, "lower", DELAY_S),
        Figure("unserved", "unserved", "%", 1, "lower", share("cohort", "cohort", "cohort_left")),
        Figure("blocked_s", "blocked time per vehicle", "s", 1, "lower", Ratio("cohort_blocked_s", "cohort")),
        Figure("collisions", "collisions", "", 2, "lower", Ratio("collisions_cv collisions_hdv")),
        Figure("red_crossings", "crossings on red", "veh", 2, "lower", Ratio("red_crossings_cv red_crossings_hdv")),
        Figure("min_ttc_s", "smallest time to collision", "s", 2, "higher", Ratio("min_ttc_sum_s", "min_ttc_vehicles")),
        Figure(
            "comfort_mps2", "mean absolute acceleration", "m/s2", 3, "lower", Ratio("abs_accel_sum", "vehicle_steps")
        ),
        Figure("jerk_mps3", "mean absolute jerk", "m/s3", 3, "lower", Ratio("abs_jerk_sum", "vehicle_steps")),
        Figure("throughput", "vehicles that crossed by the horizon", "veh", 1, "higher", Ratio("crossed")),
        Figure("unfinished_share", "not across at the horizon", "%", 1, "lower", share("unfinished", "entered")),
        Figure("emission_g_per_vehicle", "CO2 to the stop line", "g", 1, "lower", Ratio("emission_g", "crossed")),
        Figure(
            "emission_hdv_g_per_vehicle",
            "CO2 to the stop line, human-driven",
            "g",
            1,
            "lower",
            Ratio("emission_hdv_g", "crossed_hdv"),
        ),
        Figure(
            "travel_time_s_per_vehicle",
            "travel time to the stop line",
            "s",
            1,
            "lower",
            Ratio("travel_time_s", "crossed"),
        ),
        Figure("approach_speed_mps", "approach speed", "m/s", 2, "higher", Ratio("distance_m", "travel_time_s")),
        Figure("stopped_time_s_per_vehicle", "stopped time", "s", 1, "lower", Ratio("stopped_time_s", "crossed")),
        Figure("deferred_share", "deferred commands", "%", 1, "neither", share("deferred_steps", "agent_steps")),
        Figure("nan_share", "NaN commands", "%", 2, "lower", share("nan_actions", "agent_steps")),
    )
}
"""Every figure by name, in the order in which tables show them."""
HEADLINE: tuple[str, ...] = ("co2_saved", "delay_change_s", "co2_g", "delay_s", "unserved", "collisions")
"""What the first table shows; the rest is shown on request."""


def level_tensors(sums: Mapping[str, Tensor], names: tuple[str, ...]) -> dict[str, tuple[Tensor, Tensor]]:
    """Compute levels of :data:`FIGURES` in training.

    Args:
        sums: float sums by name, all of one shape ``[*B]`` (added over approaches or episodes beforehand, as wanted).
        names: of figures that are levels.

    Returns:
        ``(value, valid)`` by name, ``[*B]`` each; shares are fractions.
    """
    return {name: FIGURES[name].value.of_tensors(sums) for name in names}  # type: ignore[attr-defined]


def _added(sums: Frame, names: str) -> Array:
    if not names:
        return np.zeros(1)
    return np.sum([np.asarray(sums[name], dtype=np.float64) for name in names.split()], axis=0)
