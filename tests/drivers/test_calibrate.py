"""``python -m izoo.drivers calibrate``: from a file to a population that contexts take, and its exit codes."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("numpyro", reason="needs izoo[calibrate]")

from izoo.cli import calibrate
from izoo.conf.context_choices import PcgContexts
from izoo.contexts.population import read_population
from izoo.drivers import estimate as estimating
from izoo.errors import IzooError
from tests.conftest import Refused
from tests.drivers.platoons import MEDIANS, SPREAD, platoon_table


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pairs") / "pairs.csv"
    platoon_table(10, 80).to_csv(path, index=False)
    return path


SHORT = ("--warmup", "20", "--draws", "20", "--chains", "2")


@pytest.mark.slow
def test_from_a_file_to_contexts(
    pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "population.json"
    # Sixty draws are for a test of the command; whether they suffice is not the question here.
    monkeypatch.setattr(estimating, "MAX_R_HAT", 100.0)
    monkeypatch.setattr(estimating, "MIN_ESS", 0.0)
    monkeypatch.setattr(estimating, "MAX_DIVERGING", 1.0)
    words = ["--warmup", "60", "--draws", "60", "--chains", "2"]
    assert calibrate.main(["calibrate", str(pairs), "--out", str(out), *words]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["population.json", "population.light.png"]
    assert (tmp_path / "population.light.png").read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr().out
    for words in ("light: 10 drivers", "R-hat", "ESS", "posterior predictive checks", "built-in heavy population"):
        assert words in said
    context = PcgContexts(preset="easy", drivers=str(out)).build().sample(np.random.default_rng(0))
    assert context.drivers == read_population(out)
    for found, (name, true) in zip(context.drivers.log_mean[0], MEDIANS.items(), strict=True):
        # Of ten drivers, the mean log lies within three standard errors of the population's.
        assert found == pytest.approx(np.log(true), abs=3.5 * SPREAD / np.sqrt(10)), name
    about = json.loads(out.read_text())["calibration"]["light"]
    assert (about["drivers"], about["step_s"], about["chains"]) == (10, 0.5, 2)
    assert set(about["quantities"]["median T_s"]) == {"mean", "interval_90", "r_hat", "ess"}


@pytest.mark.slow
def test_chains_that_did_not_converge_say_so(pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "population.json"
    assert calibrate.main(["calibrate", str(pairs), "--out", str(out), *SHORT]) == calibrate.EXIT_NOT_CONVERGED == 1
    assert "NOT CONVERGED: the file says so" in capsys.readouterr().out
    with pytest.raises(IzooError, match="did not converge"):
        read_population(out)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nothing.csv", "--out", "{0}/p.json"], "nothing.csv is no file"),
        (["{1}", "--out", "{0}/p.txt"], "a file that ends in .json"),
        (["{1}", "--out", "{0}/none/p.json"], "a file in a folder that exists"),
        (["{1}", "--out", "{0}/p.json", "--step-s", "7"], r"--step-s is 7.0; it must lie in \[0.05, 1\] s"),
        (["{1}", "--out", "{0}/p.json", "--chains", "1"], r"--chains is 1; it must lie in \[2, 64\]"),
        (["{1}", "--out", "{0}/p.json", "--max-drivers", "2"], r"--max-drivers is 2"),
    ],
)
def test_bad_input_is_a_sentence_and_exit_code_2(
    words: list[str], message: str, pairs: Path, tmp_path: Path, refused: Refused
) -> None:
    error = refused(calibrate.main, ["calibrate", *(word.format(tmp_path, pairs) for word in words)])
    assert re.search(message, error) and list(tmp_path.iterdir()) == []


def test_without_the_extra_it_says_what_to_install(
    pairs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    monkeypatch.setattr(calibrate, "PACKAGES", ("no_such_package",))
    words = ["calibrate", str(pairs), "--out", str(tmp_path / "p.json")]
    refused(calibrate.main, words, "pip install 'izoo[calibrate]'")
