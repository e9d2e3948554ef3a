"""The recovery study's own arithmetic: its populations, its summary, and folders that are continued."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("numpyro", reason="needs izoo[calibrate]")

from izoo.benchmarks import calibration
from izoo.envs import MODEL_VERSION
from izoo.results.rows_file import Row, RowsFile
from tests.conftest import Refused

ABOUT = {"minutes": 1.5, "seconds": 9.0, "processor_seconds": 8.0, "converged": True}
ABOUT |= {"worst_r_hat": 1.0, "least_ess": 900.0}


def one_set(number: int, **changes: Any) -> list[Row]:
    """Rows as the study makes them: everything 10 % (or 0.1) too large, every third interval beside the truth."""
    rows = []
    for k, (name, true) in enumerate(calibration.truth(calibration.true_population(number)).items()):
        mean = true + 0.1 if name.startswith("correlation") else 1.1 * true
        low = mean - 1e-6 if k % 3 == 0 else true - 1.0
        rows.append({"name": name, "true": true, "mean": mean, "low": low, "high": mean + 1.0, **ABOUT, **changes})
    return rows


def sets_file(folder: Path) -> RowsFile:
    columns = (*calibration.SETTINGS, "name", "converged", *calibration.NUMBERS)
    return RowsFile(folder / calibration.SETS_FILE, columns, ("name",), ("set", "drivers", "warmup", "draws"))


def keep(folder: Path, *sets: list[Row], speed_noise: float = 0.0) -> None:
    kept = sets_file(folder)
    for number, rows in enumerate(sets):
        key = dict(zip(calibration.SETTINGS, (number, 30, speed_noise, 200, 400, MODEL_VERSION), strict=True))
        kept.add([{**key, **row} for row in rows])


def test_populations_are_fixed_by_their_number() -> None:
    one, other = calibration.true_population(3), calibration.true_population(4)
    assert one == calibration.true_population(3) != other
    true = calibration.truth(one)
    assert len(true) == 5 + 4 + 6
    for name, (low, high) in calibration.MEDIAN_RANGES.items():
        assert low <= true[f"median {name}"] <= high
        assert 0.1 <= true[f"spread {name}"] <= 0.25
    assert all(-1.0 < value < 1.0 for name, value in true.items() if name.startswith("correlation"))
    covariance = np.array(one.log_cov[0])
    expected = covariance[2, 3] / np.sqrt(covariance[2, 2] * covariance[3, 3])
    assert true["correlation T_s alpha_mps2"] == pytest.approx(expected)


def test_the_summary_counts_intervals_and_averages_errors() -> None:
    sets = [{**row, "set": number, "drivers": 30} for number in (0, 1) for row in one_set(number)]
    lines = calibration.summarise(pd.DataFrame(sets)).splitlines()
    assert lines[0].startswith("2 data sets, 2 converged; median: 30 drivers of 1.5 minutes")
    by_name = {line[:34].strip(): line[34:].split() for line in lines[2:-4]}
    assert by_name["median v0_mps"] == ["0%", "+10.0%", "10.0%"]
    assert by_name["median s0_m"] == ["100%", "+10.0%", "10.0%"]
    assert by_name["spread T_s"] == ["0%", "+10.0%", "10.0%"]
    assert by_name["correlation s0_m T_s"] == ["0%", "+0.10", "0.10"]
    assert lines[-1] == "all: 66.7% of 30 intervals hold the truth"


def test_a_folder_that_has_all_sets_is_summed_up_and_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    keep(tmp_path, *map(one_set, range(3)))
    monkeypatch.setattr(calibration, "recover", None)  # nothing is left to run
    assert calibration.main([f"out={tmp_path}", "sets=3", "drivers=30"]) == 0
    assert "3 data sets, 3 converged" in capsys.readouterr().out
    assert (tmp_path / "recovery.png").read_bytes().startswith(b"\x89PNG")


def test_what_cannot_be_used_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused) -> None:
    """A folder that cannot be made, and the extra that is not installed."""
    refused(calibration.main, ["out=/dev/null/x", "sets=1"], "cannot use /dev/null/x")
    monkeypatch.setitem(sys.modules, "jax", None)
    refused(calibration.main, [f"out={tmp_path}/out", "sets=1"], "calibration needs jax")
    assert not (tmp_path / "out").exists()
