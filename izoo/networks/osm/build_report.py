"""What a build from OpenStreetMap found, and what the user should know about it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from izoo.console import counted, plain
from izoo.contexts.context import FLOW_CAP_VPH_PER_LANE
from izoo.contexts.spec import IntersectionSpec
from izoo.networks.osm.counts import peak_flows
from izoo.networks.osm.plans import IMPUTED as PLAN_IMPUTED
from izoo.networks.osm.streets import StreetMap


@dataclass(frozen=True)
class OsmReport:
    """What a build found.

    Attributes:
        target: the folder that was written; :func:`izoo.networks.dataset.intersections.load_dataset` reads it.
        read: the streets of the extract.
        specs: the intersections, by id.
        streets: per intersection, the name of each leg's street.
        skipped: why other junctions with signals were left out, by id.
        stray_signals: signal nodes at no junction: pedestrian crossings, or streets cut by the extract's edge.
    """

    target: Path
    read: StreetMap
    specs: Mapping[str, IntersectionSpec]
    streets: Mapping[str, Mapping[str, str]]
    skipped: Mapping[str, str]
    stray_signals: int

    def __str__(self) -> str:
        places, read = counted(len(self.specs), "intersection"), self.read
        approaches = f"{sum(len(spec.approach_names) for spec in self.specs.values())} approaches"
        lines = [f"built {places} with {approaches} into {self.target}"]
        if read.mirrored:
            lines.append(
                f"  traffic drives on the left there ({read.mirrored}): all intersections are mirrored, east and west, "
                "left and right exchanged, so that it drives on the right; --drives-on right takes the map as it is"
            )
        for key, legs in self.streets.items():
            flows = peak_flows(self.specs[key])
            lines.append(f"  {key}: " + ", ".join(f"{k} {v or '-'}{_flow(*flows.get(k, ()))}" for k, v in legs.items()))
        lines += [f"  left out {key}: {reason}" for key, reason in self.skipped.items()]
        if self.stray_signals:
            lines.append(f"  {self.stray_signals} signal nodes stand at no junction (crossings, or the extract's edge)")
        if read.uncycled:
            lines.append(f"  {read.uncycled} signal nodes blink, meter a ramp or wait for emergencies: no cycle")
        if read.reversible:
            lines.append(f"  taken as two-way, whatever their direction by time: {', '.join(read.reversible)}")
        imputed = Counter(name.rsplit(" of ", 1)[0] for spec in self.specs.values() for name in spec.imputed)
        whole = {PLAN_IMPUTED: places}
        lines += [f"  imputed {kind}: {imputed[kind]} of {whole.get(kind, approaches)}" for kind in sorted(imputed)]
        return "\n".join(map(plain, lines))


def _flow(vph: float | None = None, cut: bool = False) -> str:
    if vph is None:
        return ""
    return f" ({vph:.0f} veh/h{f', cut to {FLOW_CAP_VPH_PER_LANE:.0f} per lane' if cut else ''})"
