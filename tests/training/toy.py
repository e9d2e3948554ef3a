"""The smallest run on SUMO: two batches of 50 steps, with a checkpoint each."""

from __future__ import annotations

TOY = [
    *("contexts=pcg_easy", "contexts.inflow_vph_per_lane=600", "env.horizon_s=75", "algo.hidden=[8]"),
    *("algo.frames_per_batch=50", "algo.minibatch_rows=64", "evaluation.contexts=0", "validation.every_batches=0"),
    *("checkpoint.every_batches=1", "collector=single", "total_frames=100"),
]
