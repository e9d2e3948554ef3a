"""The ablation: its rows are options that exist, what it says, and that it goes on."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from izoo.benchmarks import ablation
from izoo.benchmarks.ablation_options import REFERENCE, ROWS, START, AblationConfig
from izoo.conf import compose
from izoo.results import read_table
from izoo.training import runs

QUICK = [
    *("rows=[td3]", "seeds=1", "num_contexts=2", "eval_seeds=1", "horizon_s=200", "threads=1"),
    'train=["total_frames=640","env.horizon_s=160","num_envs=4","algo.hidden=[8]","algo.frames_per_batch=320"]',
]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> ablation.Bench:
    folder = tmp_path_factory.mktemp("ablation")
    return ablation.Bench(AblationConfig(num_contexts=2, out=str(folder)), folder)


@pytest.mark.parametrize("name", list(ROWS))
def test_every_row_is_a_training_run(name: str, bench: ablation.Bench) -> None:
    options = bench.runs.wanted[name, 3]
    assert options.seed == 3 and options.simulator == "twin"
    start = ROWS[name].start
    assert (options.start is not None) == (start is not None)
    if start is not None:
        assert options.start == bench.runs.wanted[start, 3].run_dir and start in AblationConfig(rows=(name,)).chosen
        begun, first = (runs._meaning(config) for config in (options, bench.options(start, 3)))
        assert begun == first, "it can begin with these policies"
    if name not in (START, REFERENCE):
        plain = bench.runs.wanted[REFERENCE, 3]
        changed = {key for key, value in vars(options).items() if value != vars(plain)[key]} - {"run_dir"}
        assert changed, "the row changes something"


def test_the_verdict_names_rows_that_are_told_apart() -> None:
    def pair(x: str, value: float, verdict: str) -> dict[str, object]:
        return {"x": x, "y": REFERENCE, "difference": {"value": value}, "verdict": verdict}

    pairs = [pair("no_kl", -2.04, "worse"), pair("td3", -0.3, "indistinguishable"), pair("glide", 3.0, "better")]
    assert ablation.verdict({"pairwise": pairs}) == "1 of 2 rows is told apart from 'whole': no_kl (-2.0 points)."
    assert ablation.verdict({"pairwise": pairs[1:]}) == "0 of 1 rows are told apart from 'whole'."


def test_bad_options_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert ablation.main(["rows=[no_kll]"]) == 2
    assert "did you mean 'no_kl'" in capsys.readouterr().err.lower()
    assert compose.compose_config("benchmarks.ablation", AblationConfig, []) == AblationConfig()


@pytest.mark.slow
def test_it_trains_compares_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [*QUICK, f"out={tmp_path}"]
    assert ablation.main(words) == 0
    (summary,) = json.loads((tmp_path / "summary.json").read_text())
    assert set(summary["entries"]) == {*ablation.SCRIPTED, "untrained", START, REFERENCE, "td3"}
    assert {pair["y"] for pair in summary["pairwise"]} == {REFERENCE}
    assert summary["entries"]["untrained"]["against"]["uncommanded"]["all"]["figures"]["co2_saved"]["value"] == 0.0
    assert (tmp_path / ablation.FIGURE_FILE).stat().st_size > 5000
    assert {path.parent.name for path in (tmp_path / "train").glob("*/seed0")} == {START, REFERENCE, "td3"}
    whole, text = read_table(tmp_path), (tmp_path / "rows.csv").read_text()
    kept = [line for line in text.splitlines(keepends=True) if ",td3," not in line]
    shutil.rmtree(tmp_path / "train/td3")
    (tmp_path / "rows.csv").write_text("".join(kept))
    capsys.readouterr()
    assert ablation.main([*words, "verbose=true"]) == 0
    out = capsys.readouterr().out
    assert "td3, seed 0" in out and f"{REFERENCE}, seed 0" not in out
    assert read_table(tmp_path).equals(whole) and (tmp_path / "rows.csv").read_text().startswith("".join(kept))
    assert ablation.main([*words[:-1], "horizon_s=240", words[-1]]) == 2
    assert "horizon_s 200.0 -> 240.0" in capsys.readouterr().err
