"""The smallest run on SUMO, two batches of 50 steps with a checkpoint each; and runs in processes of their own."""

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

TOY = [
    *("contexts=pcg_easy", "contexts.inflow_vph_per_lane=600", "env.horizon_s=75", "algo.hidden=[8]"),
    *("algo.frames_per_batch=50", "algo.minibatch_rows=64", "evaluation.contexts=0", "validation.every_batches=0"),
    *("checkpoint.every_batches=1", "collector=single", "total_frames=100"),
]


def begun(run_dir: Path, words: list[str], until: Callable[[], object]) -> subprocess.Popen[str]:
    """Start a run, and return its process once ``until`` holds, or where it has ended."""
    command = [sys.executable, "-m", "izoo.train", *words, f"run_dir={run_dir}"]
    process = subprocess.Popen(
        command, cwd=run_dir.parent, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 200
    while process.poll() is None and not until() and time.monotonic() < deadline:
        time.sleep(0.002)
    return process
