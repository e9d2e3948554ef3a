"""A city of your own from OpenStreetMap: build its intersections, look at them, try a driver in them.

``python -m izoo.docs.examples.own_city town.osm`` takes an extract of any size (``.osm`` or ``.osm.pbf``), such as the
"Export" of openstreetmap.org gives; without one it takes a small invented town. Needs ``pip install 'izoo[osm]'``.
From the shell: ``python -m izoo.contexts build --osm town.osm town``, then ``contexts=osm contexts.path=town`` for
``izoo.train`` and ``izoo.evaluate``.

What you build from OpenStreetMap is under the ODbL; say "(c) OpenStreetMap contributors" where you show it.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import pandas as pd

from izoo.envs import EnvConfig
from izoo.networks.dataset.intersections import load_dataset
from izoo.networks.osm.extract import build_from_osm
from izoo.results import evaluate_policy, print_summary, summarise

LITTLE_TOWN = Path(__file__).with_name("little_town.osm")


def main(
    extract: Path | None = None,
    target: Path | None = None,
    horizon_s: float = 1000.0,
    seeds: tuple[int, ...] = (0, 1, 2),
    num_workers: int = 2,
    max_approaches: int | None = None,
    cache: Path | None = None,
) -> pd.DataFrame:
    """Build a city from ``extract`` and compare the driver ``glide`` with human driving in it.

    Args:
        extract: an OpenStreetMap file; ``None`` takes the invented town.
        target: a new folder for the intersections; ``None`` keeps them only for this call.
        horizon_s, seeds, num_workers, cache: as for :func:`izoo.results.evaluate_policy`.
        max_approaches: how many approaches to evaluate; ``None``: all.

    Returns:
        A row per policy, context, seed and approach.
    """
    with tempfile.TemporaryDirectory() as folder:
        town = target or Path(folder) / (extract or LITTLE_TOWN).stem
        # Takes ``elevation``, a raster of heights, for grades and ``aadt``, a table of traffic counts, for demand, too.
        print(build_from_osm(extract or LITTLE_TOWN, target=town))
        # One context per approach, 40 % of the vehicles controlled; it trains like any other source of contexts.
        contexts = load_dataset(town, adoption=0.4, temperature_c=15.0, humidity_pct=60.0, season=None)
        for context in contexts:
            flow = context.flow_vph_per_lane(context.approach or "A")
            print(f"  {context.name:24s} {flow:4.0f} veh/h per lane")
        table = evaluate_policy(
            "glide",
            list(contexts)[:max_approaches],
            seeds,
            EnvConfig(horizon_s=horizon_s),
            workers=num_workers,
            progress=False,
            cache=cache,
        )
    print_summary(summarise(table))
    return table


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Build a city from an OpenStreetMap extract and try a driver in it.")
    parser.add_argument("extract", type=Path, nargs="?", help="an .osm or .osm.pbf file; default: an invented town")
    parser.add_argument("--target", type=Path, help="keep the intersections in this new folder")
    options = parser.parse_args()
    main(options.extract, options.target)
