"""Every context feature, declared once: name, unit, bounds, and whether a policy may see it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from izoo.errors import IzooError, check_range, unknown_choice


@dataclass(frozen=True)
class Feature:
    """One context feature.

    Attributes:
        name: the name used in settings, observations and messages.
        unit: its unit; empty for shares, counts and codes.
        low, high: legal range, ends included.
        scale: an observation holds ``value / scale``, of order 1; 0 for features that are never observed.
        hidden: why a policy cannot see it; empty for observed features.
    """

    name: str
    unit: str
    low: float
    high: float
    scale: float = 0.0
    hidden: str = ""

    @property
    def observed(self) -> bool:
        """Whether a policy may condition on the feature."""
        return not self.hidden

    def check(self, value: float) -> None:
        """Raise :class:`IzooError` unless ``value`` is legal."""
        check_range(self.name, value, self.low, self.high, self.unit)


_UNPREDICTABLE = "a road user cannot measure it; it belongs to the procedural, unobserved part of the context"

FEATURES = (
    Feature("adoption", "", 0.0, 1.0, 1.0),
    Feature("green_s", "s", 1.0, 300.0, 100.0),
    Feature("red_s", "s", 1.0, 300.0, 100.0),
    Feature("temperature_c", "degrees C", -60.0, 60.0, 40.0),
    Feature("humidity_pct", "%", 0.0, 100.0, 100.0),
    Feature("engine", "", 0.0, 1.0, 1.0),
    Feature("lane_count", "lanes", 1.0, 8.0, 4.0),
    Feature("lane_length_m", "m", 10.0, 5000.0, 250.0),
    Feature("speed_limit_mps", "m/s", 1.0, 60.0, 15.0),
    Feature("phase_count", "phases", 1.0, 8.0, hidden="green_s and red_s say what a vehicle meets"),
    Feature("inflow_vph_per_lane", "veh/h", 0.0, 900.0, hidden=_UNPREDICTABLE),
    Feature("offset_s", "s", -300.0, 300.0, hidden="the signals of the neighbours are out of sight"),
    Feature("grade", "", -0.35, 0.35, hidden=_UNPREDICTABLE),
    Feature("driver_aggressiveness", "", 0.0, 1.0, hidden=_UNPREDICTABLE),
    Feature("fleet", "", 0.0, 1.0, hidden=_UNPREDICTABLE),
    Feature("arrivals", "", 0.0, 1.0, hidden=_UNPREDICTABLE),
    Feature("turning", "", 0.0, 1.0, hidden=_UNPREDICTABLE),
)
"""All features. ``engine`` is 0 for combustion and 1 for electric. ``green_s`` and ``red_s`` are those of a vehicle's
own movement; their sum is the cycle. The last four are random draws made from the episode's seed."""

BY_NAME = {feature.name: feature for feature in FEATURES}
OBSERVED = tuple(feature.name for feature in FEATURES if feature.observed)
"""Names of the observed features, in the order in which an observation holds them."""


def feature(name: str) -> Feature:
    """Return the declaration of ``name``; an unknown name raises with the nearest known one."""
    if name not in BY_NAME:
        raise unknown_choice("context feature", name, BY_NAME)
    return BY_NAME[name]


def check_observed(names: Iterable[str]) -> tuple[str, ...]:
    """Check a selection of observed features and return it in the order of :data:`OBSERVED`.

    Raises:
        IzooError: a name is unknown, given twice, or belongs to an unobserved feature (the reason is in the message).
    """
    chosen = list(names)
    for name in chosen:
        declared = feature(name)
        if not declared.observed:
            raise IzooError(
                f"{name!r} cannot be observed: {declared.hidden}. Observable features: {', '.join(OBSERVED)}."
            )
    if len(set(chosen)) != len(chosen):
        raise IzooError(f"observed features {chosen} name one twice; name each once.")
    return tuple(name for name in OBSERVED if name in chosen)
