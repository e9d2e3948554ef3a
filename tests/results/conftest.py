"""Short episodes of procedural contexts, for tests on the real simulators."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from izoo.contexts.context import Context
from izoo.contexts.procedural import EASY, ProceduralSource
from izoo.envs.config import EnvConfig
from izoo.results import evaluate_policy
from tests.results import odd_policies

SHORT = EnvConfig(horizon_s=120.0, warmup_s=20.0, drain_s=60.0, num_agents=32)
SEEDS = [11, 12]


@pytest.fixture(scope="session")
def contexts() -> list[Context]:
    """Two contexts with demand from one approach."""
    base = {"lane_count": 1, "phase_count": 1, "green_s": 25}
    sources = [ProceduralSource({**base, "inflow_vph_per_lane": inflow}) for inflow in (500, 600)]
    return [source.sample(np.random.default_rng(0)) for source in sources]


@pytest.fixture(scope="session")
def easy() -> Context:
    """One fixed context with light traffic."""
    return EASY.sample(np.random.default_rng(0))


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache of baselines that the tests of a session share."""
    return tmp_path_factory.mktemp("baselines")


@pytest.fixture(scope="session")
def table(contexts: list[Context], cache: Path) -> pd.DataFrame:
    """``gentle`` and its baselines in SUMO, played in this process."""
    return evaluate_policy(odd_policies.gentle, contexts, SEEDS, SHORT, workers=0, progress=False, cache=cache)
