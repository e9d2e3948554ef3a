"""What a build from OpenStreetMap found, and what the user should know about it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from izoo.console import counted, plain
from izoo.contexts.context import FLOW_CAP_VPH_PER_LANE
from izoo.networks.osm.plans import IMPUTED as PLAN_IMPUTED


@dataclass(frozen=True)
class OsmReport:
    """What a build found.

    Attributes:
        target: the folder that was written; :func:`izoo.networks.dataset.intersections.load_dataset` reads it.
        streets: per intersection, the name of each leg's street.
        flows: per intersection and approach, vehicles per hour of the peak, and whether demand was more than is played.
        skipped: why other junctions with signals were left out, by id.
        imputed: how often each kind of value was imputed.
        approaches: number of approaches in all.
        stray_signals: signal nodes at no junction: pedestrian crossings, or streets cut by the extract's edge.
        uncycled_signals: signal nodes that show no cycle, and make no intersection.
        reversible: names, or ids of their ways, of streets whose direction changes with time; they count as two-way.
        mirrored: the region where traffic drives on the left, if the extract was mirrored.
    """

    target: Path
    streets: dict[str, dict[str, str]]
    approaches: int
    flows: dict[str, dict[str, tuple[float, bool]]] = field(default_factory=dict)
    stray_signals: int = 0
    uncycled_signals: int = 0
    reversible: tuple[str, ...] = ()
    skipped: dict[str, str] = field(default_factory=dict)
    imputed: dict[str, int] = field(default_factory=dict)
    mirrored: str = ""

    def __str__(self) -> str:
        places = counted(len(self.streets), "intersection")
        lines = [f"built {places} with {self.approaches} approaches into {self.target}"]
        if self.mirrored:
            lines.append(
                f"  traffic drives on the left there ({self.mirrored}): all intersections are mirrored, east and west, "
                "left and right exchanged, so that it drives on the right; --drives-on right takes the map as it is"
            )
        lines += [
            f"  {key}: " + ", ".join(f"{k} {v or '-'}{self._flow(key, k)}" for k, v in legs.items())
            for key, legs in self.streets.items()
        ]
        lines += [f"  left out {key}: {reason}" for key, reason in self.skipped.items()]
        if self.stray_signals:
            lines.append(f"  {self.stray_signals} signal nodes stand at no junction (crossings, or the extract's edge)")
        if self.uncycled_signals:
            lines.append(
                f"  {self.uncycled_signals} signal nodes blink, meter a ramp or wait for emergencies: no cycle"
            )
        if self.reversible:
            lines.append(f"  taken as two-way, whatever their direction by time: {', '.join(self.reversible)}")
        whole = {PLAN_IMPUTED: places}
        lines += [
            f"  imputed {kind}: {count} of {whole.get(kind, f'{self.approaches} approaches')}"
            for kind, count in self.imputed.items()
        ]
        return "\n".join(map(plain, lines))

    def _flow(self, key: str, leg: str) -> str:
        if leg not in self.flows.get(key, {}):
            return ""
        vph, cut = self.flows[key][leg]
        return f" ({vph:.0f} veh/h{f', cut to {FLOW_CAP_VPH_PER_LANE:.0f} per lane' if cut else ''})"
