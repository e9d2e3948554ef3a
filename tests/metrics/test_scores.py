"""Scores by hand, and the torch form against the table form."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import torch

from izoo.errors import IzooError
from izoo.metrics.definitions import APPROACH_METRICS
from izoo.metrics.scores import SCORES, add_scores, pool, score_tensors
from tests.metrics.tables import episode_row


def test_scores_by_hand() -> None:
    row = episode_row(10, 1500.0, unfinished=2, entered=12, stopped_time_s=80.0, min_ttc_sum_s=12.0, min_ttc_vehicles=4)
    scored = add_scores(pd.DataFrame([row]), time_weight_g_per_s=2.0).iloc[0]
    assert scored["emission_g_per_vehicle"] == 150.0
    assert scored["emission_g_per_vehicle_step"] == 1.5
    assert scored["throughput"] == 10
    assert scored["travel_time_s_per_vehicle"] == 50.0
    assert scored["approach_speed_mps"] == 8.0
    assert scored["stopped_time_s_per_vehicle"] == 8.0
    assert scored["min_ttc_s"] == 3.0
    assert scored["unfinished_share"] == pytest.approx(2 / 12)
    assert scored["objective_g"] == 1500.0 + 2.0 * 600.0


def test_a_mean_over_nothing_is_missing_not_zero() -> None:
    scored = add_scores(pd.DataFrame([episode_row(0, 0.0)])).iloc[0]
    assert np.isnan(scored["emission_g_per_vehicle"])
    assert np.isnan(scored["deferred_share"])
    assert scored["throughput"] == 0


def test_pool_weighs_vehicles_not_rows() -> None:
    table = pd.DataFrame([episode_row(1, 300.0, seed=0), episode_row(9, 900.0, seed=1)])
    pooled = pool(table, ["policy"])
    assert len(pooled) == 1
    assert pooled["rows"][0] == 2
    assert pooled["emission_g_per_vehicle"][0] == 120.0


def test_torch_form_equals_table_form() -> None:
    generator = np.random.default_rng(0)
    table = pd.DataFrame([episode_row(0, 0.0, seed=k) for k in range(6)])
    table[list(APPROACH_METRICS)] = generator.integers(0, 3, size=(6, len(APPROACH_METRICS))).astype(float)
    scored = add_scores(table)
    tensors = score_tensors({name: torch.tensor(table[name].to_numpy(float)) for name in APPROACH_METRICS})
    assert set(tensors) == set(SCORES)
    for name, (value, valid) in tensors.items():
        column = scored[name].to_numpy(float)
        assert np.array_equal(valid.numpy(), ~np.isnan(column)), name
        assert np.array_equal(value.numpy(), np.nan_to_num(column)), name


def test_scores_name_only_known_sums() -> None:
    for score in SCORES.values():
        assert set(score.numerator) <= set(APPROACH_METRICS)
        assert set(score.denominator) <= set(APPROACH_METRICS)


def test_a_table_of_another_version_is_refused() -> None:
    with pytest.raises(IzooError, match="crossed"):
        add_scores(pd.DataFrame([episode_row(1, 1.0)]).drop(columns="crossed"))
