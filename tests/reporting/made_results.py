"""Results folders for the tests of the report: made from one real, small evaluation."""

from __future__ import annotations

import shutil
from pathlib import Path

import pandas as pd

from izoo.reporting.results import EntryRecord, Results, RunRecord, write_results

METRICS = (
    "frames,seconds,return,emission_g_per_vehicle,throughput_veh_per_episode,stopped_time_s_per_vehicle\n"
    "1000,10,-30.5,90,40,30\n2000,20,-28,85.5,41,28\n3000,30,-27.5,84,41,27\n"
)


def rename_policy(source: Path, target: Path, old: str, new: str, factor: float = 1.0) -> Path:
    """Copy an evaluation with one policy renamed and its emission multiplied."""
    shutil.copytree(source, target)
    table = pd.read_csv(target / "evaluation.csv", dtype={"seed": str})
    table.loc[table["policy"] == old, "emission_g"] *= factor
    table["policy"] = table["policy"].replace({old: new})
    table.to_csv(target / "evaluation.csv", index=False)
    manifest = target / "evaluation.json"
    manifest.write_text(manifest.read_text().replace(f'"{old}"', f'"{new}"'))
    return target


def benchmark(evaluation: Path, folder: Path, status: str = "done") -> Path:
    """A benchmark's folder of two training seeds of ``ppo`` and one scripted ``glide``."""
    runs = []
    for seed, factor in ((0, 1.0), (1, 0.9)):
        where = f"evaluation/ppo/seed{seed}"
        rename_policy(evaluation, folder / where, "glide", "ppo", factor)
        run = folder / f"train/ppo/seed{seed}"
        run.mkdir(parents=True)
        (run / "metrics.csv").write_text(METRICS)
        (run / "validation.csv").write_text("frames,benefit_exact\n1000,0.01\n3000,0.05\n")
        runs.append(RunRecord(seed, "done" if seed == 0 else status, where, f"train/ppo/seed{seed}", 3000, 30.0))
    shutil.copytree(evaluation, folder / "evaluation/glide/seed0")
    entries = (
        EntryRecord("ppo", "trained", "ppo", "direct", tuple(runs)),
        EntryRecord("glide", "scripted", None, None, (RunRecord(0, "done", "evaluation/glide/seed0"),)),
    )
    contexts = {"train": "two roads", "test": "the same roads", "test_count": 2, "eval_seeds": 2}
    results = Results("here -> there", "in_distribution", "smoke", {}, {"izoo": "0"}, contexts, entries)
    write_results(folder, results)
    return folder
