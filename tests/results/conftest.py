"""Short episodes of procedural contexts, for tests on the real simulators."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from izoo.contexts.context import Context
from izoo.contexts.procedural import EASY
from izoo.results import evaluate_policy
from tests.conftest import SHORT
from tests.results import odd_policies

SEEDS = [11, 12]


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
