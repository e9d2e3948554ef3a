"""The ablation: its rows are options that exist, what it says, and that it goes on."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from izoo.benchmarks import ablation
from izoo.benchmarks.campaign.ablation_options import REFERENCE, ROWS, AblationConfig
from izoo.cli import compose
from izoo.results import read_table
from izoo.training.option_checks import check_options

ROW = "every_8_s-none-own"
QUICK = [
    *("rows=[every_8_s-none-own]", "seeds=1", "num_contexts=2", "eval_seeds=1", "horizon_s=200", "threads=1"),
    'train=["total_frames=80","env.horizon_s=160","num_envs=4","algo.hidden=[8]","algo.frames_per_batch=40",'
    '"validation.every_batches=1","validation.contexts=2"]',
]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> ablation.Bench:
    folder = tmp_path_factory.mktemp("ablation")
    return ablation.Bench(AblationConfig(num_contexts=2, out=str(folder)), folder)


@pytest.mark.parametrize("name", list(ROWS))
def test_every_row_is_a_training_run(name: str, bench: ablation.Bench) -> None:
    options = bench.runs.wanted[name, 3]
    check_options(options)
    assert options.seed == 3 and options.simulator == "twin"
    assert options.total_frames >= 5 * options.validation.every_batches * options.algo.frames_per_batch, "a curve"
    if name != REFERENCE:
        plain = bench.runs.wanted[REFERENCE, 3]
        changed = {key for key, value in vars(options).items() if value != vars(plain)[key]} - {"run_dir"}
        assert changed, "the row changes something"


def test_the_verdict_names_rows_that_are_told_apart() -> None:
    def pair(x: str, value: float, verdict: str) -> dict[str, object]:
        return {"x": x, "y": REFERENCE, "difference": {"value": value}, "verdict": verdict}

    first, second = "every_8_s-none-team", "every_2_s-paired-own"
    pairs = [pair(first, -2.04, "worse"), pair(second, -0.3, "indistinguishable"), pair("glide", 3.0, "better")]
    said = f"1 of 2 rows is told apart from '{REFERENCE}': {first} (-2.0 points)."
    assert ablation.verdict({"pairwise": pairs}) == said
    assert ablation.verdict({"pairwise": pairs[1:]}) == f"0 of 1 rows are told apart from '{REFERENCE}'."


def test_bad_options_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert ablation.main(["rows=[every_8_s-none-teams]"]) == 2
    assert "did you mean 'every_8_s-none-team'" in capsys.readouterr().err.lower()
    assert compose.compose_config(AblationConfig, []) == AblationConfig()


@pytest.mark.slow
def test_it_trains_compares_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [*QUICK, f"out={tmp_path}"]
    assert ablation.main(words) == 0
    (summary,) = json.loads((tmp_path / "summary.json").read_text())
    assert set(summary["entries"]) == {*ablation.SCRIPTED, "untrained", REFERENCE, ROW}
    assert {pair["y"] for pair in summary["pairwise"]} == {REFERENCE}
    assert (tmp_path / ablation.FIGURE_FILE).stat().st_size > 5000
    for column in ablation.SHOWN:
        decisions, values = ablation.curve(tmp_path / "train" / REFERENCE / "seed0", column)
        assert len(values) == 2 and 0 < decisions[0] < decisions[1]
    assert {path.parent.name for path in (tmp_path / "train").glob("*/seed0")} == {REFERENCE, ROW}
    whole, text = read_table(tmp_path), (tmp_path / "rows.csv").read_text()
    kept = [line for line in text.splitlines(keepends=True) if f",{ROW}," not in line]
    shutil.rmtree(tmp_path / "train" / ROW)
    (tmp_path / "rows.csv").write_text("".join(kept))
    capsys.readouterr()
    assert ablation.main([*words, "verbose=true"]) == 0
    out = capsys.readouterr().out
    assert f"{ROW}, seed 0" in out and f"{REFERENCE}, seed 0" not in out
    assert read_table(tmp_path).equals(whole) and (tmp_path / "rows.csv").read_text().startswith("".join(kept))
    assert ablation.main([*words[:-1], "horizon_s=240", words[-1]]) == 2
    assert "horizon_s 200.0 -> 240.0" in capsys.readouterr().err
