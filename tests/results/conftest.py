"""Short episodes of procedural contexts, for tests on the real simulators."""

import functools
from collections.abc import Callable
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
Evaluate = Callable[..., pd.DataFrame]


@pytest.fixture(scope="session")
def easy() -> Context:
    """One fixed context with light traffic."""
    return EASY.sample(np.random.default_rng(0))


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache of baselines that the tests of a session share."""
    return tmp_path_factory.mktemp("baselines")


@pytest.fixture(scope="session")
def evaluate(cache: Path) -> Evaluate:
    """:func:`~izoo.results.evaluate_policy` in SUMO and in this process."""
    return functools.partial(evaluate_policy, config=SHORT, workers=0, progress=False, cache=cache)


@pytest.fixture(scope="session")
def table(contexts: list[Context], evaluate: Evaluate) -> pd.DataFrame:
    """``gentle`` and its baselines."""
    return evaluate(odd_policies.gentle, contexts, SEEDS)
