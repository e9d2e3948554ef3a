"""The registry of figures: by hand, in both forms, and over sums that exist."""

import numpy as np
import pandas as pd
import pytest
import torch

from izoo.envs.mdp.metric_sums import APPROACH_METRICS
from izoo.metrics.figures import FIGURES, HEADLINE, Ratio, level_tensors
from tests.metrics.tables import episode_row


def value(name: str, own: dict[str, object], baseline: dict[str, object] | None = None) -> float:
    tables = (pd.DataFrame([row]) for row in (own, baseline or own))
    return float(FIGURES[name].value(*tables)[0])


def test_the_measure_by_hand() -> None:
    sums = {"cohort_region_co2_g": 700.0, "cohort_blocked_co2_g": 200.0, "cohort_region_delay_s": 150.0}
    own = episode_row(cohort=10, cohort_left=9, cohort_blocked_s=50.0, **sums)
    baseline = episode_row(100.0, 18.0)
    found = [value(name, own) for name in ("co2_g", "delay_s", "blocked_s", "unserved")]
    assert found == pytest.approx([90.0, 20.0, 5.0, 10.0])
    assert value("co2_saved", own, baseline) == pytest.approx(10.0)
    assert value("delay_change_s", own, baseline) == pytest.approx(2.0)


def test_levels_by_hand() -> None:
    sums = {"entered": 12, "unfinished": 2, "emission_g": 1500.0, "stopped_time_s": 80.0, "min_ttc_sum_s": 12.0}
    sums |= {"min_ttc_vehicles": 4, "collisions_cv": 1, "collisions_hdv": 2}
    row = episode_row(cohort=10, agent_steps=200, deferred_steps=30, nan_actions=1, **sums)
    expected = {"emission_g_per_vehicle": 150.0, "throughput": 10.0, "travel_time_s_per_vehicle": 50.0}
    expected |= {"approach_speed_mps": 8.0, "stopped_time_s_per_vehicle": 8.0, "min_ttc_s": 3.0, "collisions": 3.0}
    expected |= {"unfinished_share": 100.0 * 2 / 12, "deferred_share": 15.0, "nan_share": 0.5}
    for name, number in expected.items():
        assert value(name, row) == pytest.approx(number), name


def test_a_mean_over_nothing_is_missing_not_0() -> None:
    empty = episode_row(cohort=0.0)
    for name in ("co2_g", "unserved", "co2_saved", "deferred_share", "min_ttc_s"):
        assert np.isnan(value(name, empty)), name
    assert value("throughput", empty) == 0.0


def test_the_form_of_training_equals_that_of_tables() -> None:
    generator = np.random.default_rng(0)
    sums = {name: generator.integers(0, 3, 50).astype(float) for name in APPROACH_METRICS}
    levels = tuple(name for name, figure in FIGURES.items() if not figure.paired)
    found = level_tensors({name: torch.from_numpy(column) for name, column in sums.items()}, levels)
    assert set(found) == set(levels)
    for name, (number, valid) in found.items():
        column = FIGURES[name].value(sums, sums)
        scale = 100.0 if FIGURES[name].unit == "%" else 1.0
        assert np.array_equal(valid.numpy(), ~np.isnan(column)), name
        assert np.allclose(scale * number.numpy(), np.nan_to_num(column)), name


def test_every_figure_is_declared_whole() -> None:
    assert len(HEADLINE) <= 6 and set(HEADLINE) <= set(FIGURES)
    for name, figure in FIGURES.items():
        assert figure.name == name and figure.label and figure.digits >= 0
        if isinstance(figure.value, Ratio):
            used = {*figure.value.top.split(), *figure.value.bottom.split(), *figure.value.minus.split()}
            assert used <= set(APPROACH_METRICS) and not figure.paired
