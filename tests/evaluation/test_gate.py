"""Why evaluation is paired: what the exact gate does to a policy that changes nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from izoo.contexts.context import Context
from izoo.evaluation import evaluate_policy
from izoo.metrics.benefit import benefits
from izoo.metrics.definitions import APPROACH_METRICS
from tests.evaluation.conftest import SHORT

pytestmark = pytest.mark.slow
EPISODES, PER_COMPARISON, COMPARISONS = 24, 3, 100


@pytest.fixture(scope="module")
def idle(contexts: list[Context], cache: Path) -> pd.DataFrame:
    """Uncommanded CVs that are human drivers in all but name, and human driving, in one context over many seeds."""
    context = contexts[0].replace(cv_vehicle="human")
    seeds = list(range(EPISODES))
    return evaluate_policy("uncommanded", [context], seeds, SHORT, num_workers=0, progress=False, cache=cache)


def test_the_policy_is_identical_to_the_baseline(idle: pd.DataFrame) -> None:
    policy, baseline = (idle[idle["policy"] == name].reset_index(drop=True) for name in ("uncommanded", "human"))
    same = [name for name in APPROACH_METRICS if name not in {"agent_steps", "deferred_steps"}]
    different = [name for name in same if not np.array_equal(policy[name], baseline[name])]
    # What is counted by who drives differs in name only.
    assert set(different) <= {"crossed_hdv", "emission_hdv_g", "junction_deferred", "lane_change_deferred"}
    assert policy["crossed"].std() > 0.0, "episodes must differ for the gate to have something to fall for"


def share_gated(table: pd.DataFrame, paired: bool) -> float:
    """Share of comparisons of :data:`PER_COMPARISON` episodes that the exact gate sets to 0."""
    generator = np.random.default_rng(0)
    policy, baseline = (table[table["policy"] == name].set_index("seed") for name in ("uncommanded", "human"))
    fell = []
    for _ in range(COMPARISONS):
        drawn = generator.choice(EPISODES, 2 * PER_COMPARISON, replace=False)
        chosen, others = drawn[:PER_COMPARISON], drawn[PER_COMPARISON:]
        mine = policy.loc[chosen].reset_index()
        theirs = baseline.loc[chosen if paired else others].reset_index().assign(seed=chosen)
        fell.append(bool(benefits(mine, theirs)["gated_exact"].iloc[0]))
    return float(np.mean(fell))


def test_the_exact_gate_never_fails_it_when_paired(idle: pd.DataFrame) -> None:
    assert share_gated(idle, paired=True) == 0.0


def test_the_exact_gate_fails_it_about_half_the_time_when_unpaired(idle: pd.DataFrame) -> None:
    assert 0.35 < share_gated(idle, paired=False) < 0.6
