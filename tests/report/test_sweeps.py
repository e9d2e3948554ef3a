"""The table and the picture of a sweep, from run folders."""

import sys
from pathlib import Path

import pandas as pd
import pytest
from matplotlib import image

from izoo import train
from izoo.algos.learners.ddpg import DDPGConfig
from izoo.algos.learners.ppo import PPOConfig
from izoo.conf.train_options import TrainConfig
from izoo.report import __main__ as report
from izoo.report import sweeps
from izoo.training import run_folder
from izoo.training.loggers import MetricsTable
from tests.conftest import Refused
from tests.report.made_tables import folder as results_folder
from tests.report.made_tables import table as rows


def make_run(
    folder: Path, config: TrainConfig, frames: int, returns: float, benefits: tuple[float, ...], evaluated: float | None
) -> None:
    """Write what a run leaves behind."""
    folder.mkdir(parents=True)
    run_folder.write_config(folder, config)
    table = MetricsTable(folder / run_folder.METRICS_FILE)
    table.append({"frames": frames // 2, "seconds": 1800.0, "return": returns})
    table.append({"frames": frames, "seconds": 3600.0})
    validation = MetricsTable(folder / "validation.csv")
    for number, benefit in enumerate(benefits):
        validation.append({"frames": number + 1, "co2_saved": benefit})
    if evaluated is not None:
        results_folder(folder / "evaluations" / "last", rows({"ppo": (evaluated, 0.0, 1)}, places=7))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two algorithms, two seeds each, one of them killed; and a run that was killed before it had options."""
    for number, (algo, seed) in enumerate([(PPOConfig(), 0), (PPOConfig(), 1), (DDPGConfig(), 0), (DDPGConfig(), 1)]):
        config = TrainConfig(algo=algo, seed=seed, total_frames=1000)
        frames = 400 if number == 3 else 1000
        benefits = (1.0, 3.0, 2.0) if seed == 0 else (5.0,)
        make_run(tmp_path / f"{number}-run", config, frames, -10.0 * number, benefits, 0.1 if seed == 0 else None)
    return tmp_path


def test_choices_are_averaged_over_their_seeds(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert report.main([str(folder)]) == 0
    table = pd.read_csv(folder / sweeps.SWEEP_FILE)
    assert table["algo.name"].tolist() == ["ppo", "ddpg"], "hyper-parameters that one algorithm lacks do not vary"
    assert table["runs"].tolist() == [2, 2] and table["finished"].tolist() == [2, 1]
    expected = {"best": [4.0, 4.0], "last": [3.5, 3.5], "return": [-5.0, -25.0], "frames": [2000, 1400]}
    for name, values in (expected | {"hours_per_run": [1.0, 1.0]}).items():
        assert table[name].tolist() == pytest.approx(values), name
    assert table["evaluation"].tolist() == pytest.approx([10.0, 10.0], abs=1.0)
    assert len(pd.read_csv(folder / sweeps.RUNS_FILE)) == 4
    assert image.imread(folder / sweeps.CURVES_FILE).shape[2] == 4
    out = capsys.readouterr().out
    assert "1/2" in out and "3-run: unfinished, 400 frames" in out
    assert "+4.0 %" in out


def test_options_that_vary_become_columns(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(folder / "4-run", TrainConfig(algo=PPOConfig(lr=1e-3), total_frames=1000), 1000, -1.0, (), None)
    sweeps.report(folder)
    table = pd.read_csv(folder / sweeps.SWEEP_FILE)
    assert sorted(table.columns[:2]) == ["algo.lr", "algo.name"] and len(table) == 3
    assert pd.isna(table.loc[table["algo.lr"] == 1e-3, "best"]).all()
    out = " ".join(capsys.readouterr().out.split())
    assert all(f"{number}: algo." in out for number in (1, 2, 3)) and "algo.lr=0.001" in out.replace(" ", "")


@pytest.mark.parametrize("word", ["out=page.html", "title=T", "replay=false", "partial=true"])
def test_options_of_the_page_are_refused(
    folder: Path, word: str, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    monkeypatch.chdir(folder)
    said = f"the folder of a sweep, to which {word.partition('=')[0]} cannot apply"
    refused(report.main, [str(folder), word], said)
    assert not (folder / sweeps.SWEEP_FILE).exists() and not (folder / "page.html").exists()


def test_a_run_does_not_make_the_report_import_code(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    (here / "evil.py").write_text("open('ran', 'w').close()\n")
    make_run(here / "sweep" / "0", TrainConfig(), 1000, 0.0, (), None)
    path = here / "sweep" / "0" / run_folder.CONFIG_FILE
    path.write_text(path.read_text().replace("name: ppo", "name: evil:Thing"))
    assert report.main(["sweep"]) == 0
    assert "imports=true allows to import it" in " ".join(capsys.readouterr().out.split())
    assert not (here / "ran").exists()
    assert report.main(["sweep", "imports=true"]) == 0
    assert (here / "ran").exists()


def test_a_multirun_of_the_command_gives_a_table(here: Path) -> None:
    words = ["contexts=pcg_easy", "env.horizon_s=75", "algo.hidden=[8]", "evaluation.contexts=0", "total_frames=100"]
    words += ["collector=single", "algo.frames_per_batch=100", "algo.minibatch_rows=64", "run_dir='sweep/${algo.lr}'"]
    assert train.main(["-m", *words, "algo.lr=1e-3,1e-4", "seed=0"]) == 0
    assert report.main([str(here / "sweep")]) == 0
    table = pd.read_csv(here / "sweep" / sweeps.SWEEP_FILE)
    assert sorted(table["algo.lr"]) == [1e-4, 1e-3] and table["finished"].tolist() == [1, 1]
