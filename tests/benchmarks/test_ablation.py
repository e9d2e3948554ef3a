"""The ablation: its rows are options that exist, its figures are of what was played, and it goes on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from izoo import files
from izoo.benchmarks import ablation
from izoo.benchmarks.ablation_options import REFERENCE, ROWS, START, AblationConfig
from izoo.conf import compose
from izoo.errors import IzooError
from izoo.training import runs

QUICK = [
    *("rows=[td3]", "seeds=1", "num_contexts=2", "eval_seeds=1", "horizon_s=200", "threads=1"),
    'train=["total_frames=640","env.horizon_s=160","num_envs=4","algo.hidden=[8]","algo.frames_per_batch=320"]',
]


@pytest.mark.parametrize("name", list(ROWS))
def test_every_row_is_a_training_run(name: str, tmp_path: Path) -> None:
    bench = ablation.Bench(AblationConfig(num_contexts=2, out=str(tmp_path)), tmp_path)
    options = bench.options(name, 3)
    assert options.seed == 3 and options.simulator == "twin"
    start = ROWS[name].start
    assert (options.start is not None) == (start is not None)
    if start is not None:
        assert start in AblationConfig(rows=(name,)).chosen
        begun, first = (runs._meaning(config) for config in (options, bench.options(start, 3)))
        assert begun == first, "it can begin with these policies"
    if name not in (START, REFERENCE):
        plain = bench.options(REFERENCE, 3)
        changed = {key for key, value in vars(options).items() if value != vars(plain)[key]} - {"run_dir"}
        assert changed, "the row changes something"


def sums(burned_g: float, first: tuple[float, float] | None = None) -> dict[str, Any]:
    """Sums of six contexts, 10 vehicles through; the first one may have its own, and the last has no traffic."""
    burned, crossed = first or (burned_g, 10.0)
    return {"demand_emission_g": [burned, *[burned_g] * 4, 0.0], "crossed": [crossed, *[10.0] * 4, 0.0]}


def entries(human: dict[str, Any], quiet: dict[str, Any], row: dict[str, Any]) -> dict[str, dict[int, dict[str, Any]]]:
    return {
        "human": {0: human},
        "uncommanded": {0: quiet},
        "glide": {0: quiet},
        "untrained": {0: quiet, 1: quiet},
        REFERENCE: {0: quiet, 1: {**row, "train_cpu_s": 3.0}},
        "no_kl": {1: row, 0: row},
    }


def test_a_policy_that_lets_nobody_through_is_charged_for_it(tmp_path: Path) -> None:
    """As if one vehicle had crossed."""
    blocked = sums(900.0, first=(2700.0, 0.0))
    found = ablation.summary(entries(sums(1000.0), sums(900.0), blocked), [f"place {k}" for k in range(6)])
    assert found["no_kl"]["over_uncommanded"]["value"] == pytest.approx((1 - 2700 / 90) / 5)
    assert found["no_kl"]["per_seed"] == pytest.approx([(1 - 2700 / 90) / 5] * 2)
    files.write_json(tmp_path / "rows.json", found)
    ablation.table(found)
    ablation.draw(found, tmp_path / "ablation.png")
    assert (tmp_path / "ablation.png").stat().st_size > 5000


def test_without_a_context_that_counts_there_are_no_figures(tmp_path: Path) -> None:
    nothing = {"demand_emission_g": [0.0], "crossed": [0.0]}
    found = ablation.summary(entries(nothing, nothing, nothing), ["place"])
    assert found["no_kl"]["over_uncommanded"]["value"] is None and found["no_kl"]["per_seed"] == []
    files.write_json(tmp_path / "rows.json", found)
    ablation.draw(found, tmp_path / "ablation.png")
    assert ablation.table(found).row_count == len(found)


def test_the_summary_by_hand() -> None:
    """Six contexts, the last without traffic: it counts nowhere."""
    human, quiet = sums(1000.0), sums(900.0)
    row = sums(900.0, first=(810.0, 10.0))
    found = ablation.summary(entries(human, quiet, row), [f"place {k}" for k in range(6)])
    assert found["human"]["over_uncommanded"]["value"] == pytest.approx(1 - 100 / 90)
    assert found[REFERENCE]["over_uncommanded"]["value"] == pytest.approx(0.5 * 0.1 / 5)
    assert found[REFERENCE]["over_human"]["value"] == pytest.approx(0.1 + 0.5 * 0.9 * 0.1 / 5)
    assert found[REFERENCE]["per_seed"] == pytest.approx([0.0, 0.02]) and found[REFERENCE]["train_cpu_s"] == 3.0
    assert found["no_kl"]["over_reference"]["value"] == pytest.approx(0.01)
    assert "over_reference" not in found["glide"] and found["no_kl"]["over_uncommanded"]["n"] == 5
    assert np.isfinite([line["through_over_uncommanded"]["value"] for line in found.values()]).all()


def test_bad_options_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert ablation.main(["rows=[no_kll]"]) == 2
    assert "did you mean 'no_kl'" in capsys.readouterr().err.lower()
    assert compose.compose_config("benchmarks.ablation", AblationConfig, []) == AblationConfig()


@pytest.mark.slow
def test_it_trains_compares_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [*QUICK, f"out={tmp_path}"]
    assert ablation.main(words) == 0
    result = json.loads((tmp_path / ablation.RESULT_FILE).read_text())
    assert set(result["rows"]) == {"untrained", "glide", "human", START, REFERENCE, "td3"}
    assert result["rows"]["untrained"]["over_uncommanded"]["value"] == 0.0
    assert (tmp_path / ablation.FIGURE_FILE).stat().st_size > 5000
    removed = tmp_path / "results" / "td3-seed0.json"
    kept = tmp_path / "results" / f"{REFERENCE}-seed0.json"
    before, stamp = json.loads(removed.read_text()), kept.stat().st_mtime_ns
    removed.unlink()
    capsys.readouterr()
    assert ablation.main(words) == 0
    out = capsys.readouterr().out
    assert "td3, seed 0" in out and f"{REFERENCE}, seed 0" not in out
    after = json.loads(removed.read_text())
    assert after["demand_emission_g"] == before["demand_emission_g"] and kept.stat().st_mtime_ns == stamp
    assert ablation.main([*words[:-1], "horizon_s=240", words[-1]]) == 2
    assert "other settings" in capsys.readouterr().err


def test_a_damaged_result_is_named(tmp_path: Path) -> None:
    bench = ablation.Bench(AblationConfig(num_contexts=2, out=str(tmp_path)), tmp_path)
    (tmp_path / "results").mkdir()
    for content in ("{", "[]", '{"about": 3}'):
        (tmp_path / "results" / "glide-seed0.json").write_text(content)
        with pytest.raises(IzooError, match="remove it, and it is made anew"):
            bench._play("glide", 0, dict)


def test_a_result_of_other_code_is_refused(tmp_path: Path) -> None:
    bench = ablation.Bench(AblationConfig(num_contexts=2, out=str(tmp_path)), tmp_path)
    bench._play("glide", 0, lambda: {"crossed": [1.0]})
    bench._play("glide", 0, dict)
    assert bench.entries["glide"][0] == {"crossed": [1.0]}
    assert set(bench.about["versions"]) > {"code", "drivers", "torch"}
    bench.about["versions"] = {**bench.about["versions"], "drivers": "before"}
    with pytest.raises(IzooError, match=r"other settings or versions \(versions.drivers .* -> before\)"):
        bench._play("glide", 0, dict)
