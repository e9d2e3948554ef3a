"""One real evaluation and its page, shared by the tests of replays and of the browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from izoo.contexts.context import Context
from izoo.contexts.procedural import ProceduralSource
from izoo.envs.config import EnvConfig
from izoo.report.__main__ import main
from izoo.results.rollout import evaluate_policy

SHORT = EnvConfig(horizon_s=120.0, warmup_s=20.0, num_agents=32, drain_s=60.0)


@pytest.fixture(scope="session")
def contexts() -> list[Context]:
    """Two contexts with demand from one approach."""
    base = {"lane_count": 1, "phase_count": 1, "green_s": 25}
    sources = [ProceduralSource({**base, "inflow_vph_per_lane": inflow}) for inflow in (500, 600)]
    return [source.sample(np.random.default_rng(0)) for source in sources]


@pytest.fixture(scope="session")
def evaluation(contexts: list[Context], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of glide's evaluation on two contexts and two seeds; not to be changed."""
    folder = tmp_path_factory.mktemp("results") / "a <script>alert(1)<script> & more"
    cache = tmp_path_factory.mktemp("baselines")
    evaluate_policy("glide", contexts, [1, 2], SHORT, workers=0, out=folder, cache=cache)
    return folder


@pytest.fixture(scope="session")
def page(evaluation: Path) -> Path:
    """Its page, with replays."""
    assert main([str(evaluation)]) == 0
    return evaluation / "report.html"
