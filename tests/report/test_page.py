"""The page of a folder of results: whole, safe, and refused in one sentence where the folder is something else."""

import base64
import gzip
import html
import json
import re
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import pytest

from izoo.metrics.figures import FIGURES
from izoo.report import tables
from izoo.report.__main__ import main
from izoo.report.report_data import collect
from tests.conftest import Refused
from tests.report.made_tables import SEVERAL, folder, table

HOSTILE = "<script>alert(1)</script>"
METRICS = (
    "frames,seconds,return,emission_g_per_vehicle,throughput_veh_per_episode,co2_saved\n"
    "1000,10,-30.5,90,40,-3\n2000,20,-28,85.5,41,1\n3000,30,-27.5,84,41,2\n"
)
VALIDATION = "frames,co2_saved,co2_saved_low,co2_saved_high\n1000,0.5,,\n3000,2.5,1.0,4.0\n"


class Tags(HTMLParser):
    """Elements that are open, and how many there are of each."""

    VOID = frozenset({"meta", "link", "input", "img", "br"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.count: Counter[str] = Counter()

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.count[tag] += 1
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def content_of(page: Path) -> dict:
    packed = re.search(r'id="content-pack">([^<]*)<', page.read_text())
    assert packed is not None
    return json.loads(gzip.decompress(base64.b64decode(packed[1])))


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a benchmark with two training runs, and its page."""
    path = folder(tmp_path_factory.mktemp("made") / "board", table(SEVERAL))
    for seed in (0, 1):
        run = path / "train" / "ppo" / f"seed{seed}"
        run.mkdir(parents=True)
        (run / "metrics.csv").write_text(METRICS)
        (run / "validation.csv").write_text(VALIDATION)
    assert main([str(path)]) == 0
    return path


def test_the_page_is_whole_and_needs_nothing_else(results: Path) -> None:
    page = results / "report.html"
    text = page.read_text()
    parser = Tags()
    parser.feed(text)
    assert parser.open == []
    assert not re.search(r"""<[^>]*\s(src|href)=["'](?!#|data:)""", text)
    assert page.stat().st_size < 700_000
    content = content_of(page)
    places = set(re.findall('data-figure="([^"]*)"', text))
    assert text.count("<svg") == len(places) and "plotly" not in text
    assert {"forest", "profiles", "tradeoff", "histogram-0", "curve-return", "curve-validation-co2-saved"} <= places
    assert re.findall('role="img" aria-label="([^"]+)"', text)
    assert set(content["rows"]["policy"]) == {*SEVERAL, "uncommanded"} and len(content["rows"]["policy"]) == 48


def test_the_page_says_what_the_tables_say(results: Path) -> None:
    text = (results / "report.html").read_text()
    (evaluation,) = collect(results).evaluations
    assert html.escape(evaluation.summary["verdict"]) in text
    assert tables.headline(evaluation.summary).html() in text
    assert all(figure.label in text for figure in FIGURES.values())
    rows = content_of(results / "report.html")["rows"]
    saved = [v for v, name in zip(rows["co2_saved"], rows["policy"], strict=True) if name == "cap_0.6"]
    assert 7.0 < sum(saved) / len(saved) < 9.0
    assert 'data-figure="published"' not in text and "The paper's form" not in text, "the task is not the paper's"


def test_published_figures_stand_beside_the_papers_protocol(tmp_path: Path) -> None:
    made = folder(tmp_path / "results", table(SEVERAL).assign(task="salt_lake_city_paper"), "salt_lake_city_paper")
    assert main([str(made), "replay=false"]) == 0
    text = (made / "report.html").read_text()
    assert "DDPG, published" in text and "-1.85 %" in text and 'data-figure="published"' in text


@pytest.mark.slow
def test_the_same_results_give_the_same_page(results: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        assert main([str(results), f"out={tmp_path / name}.html", "replay=false"]) == 0
    assert (tmp_path / "one.html").read_bytes() == (tmp_path / "two.html").read_bytes()


def test_names_from_files_stay_text(tmp_path: Path) -> None:
    path = folder(tmp_path / "results", table({HOSTILE: (0.06, -1.0, 1), "glide": (0.0, 0.0, 1)}))
    assert main([str(path), f"title={HOSTILE}", "replay=false"]) == 0
    text = (path / "report.html").read_text()
    assert HOSTILE not in text
    assert "<h1>&lt;script&gt;alert(1)&lt;/script&gt;</h1>" in text
    assert text.count("<script") == 2, "what stands in figures is text, too"


def test_the_page_says_where_commands_were_nan(tmp_path: Path) -> None:
    """What the simulator drove in a policy's place must not pass for its benefit."""
    made = table({"glide": (0.03, 0.0, 1)})
    made.loc[made["policy"] == "glide", "nan_actions"] = made["agent_steps"] / 2
    path = folder(tmp_path / "results", made)
    assert main([str(path), "replay=false"]) == 0
    assert "glide: 50.00 % of its commands were NaN" in (path / "report.html").read_text()


def test_tasks_of_a_table_and_evaluations_of_a_run_are_told_apart(tmp_path: Path) -> None:
    run = tmp_path / "run"
    for name, task in (("last", "town test"), ("other", "town test, human vehicles")):
        folder(run / "evaluations" / name, table({"ppo": (0.06, -1.0, 1)}).assign(task=task), task)
    (run / "config.yaml").write_text("seed: 0\n")
    (run / "metrics.csv").write_text(METRICS)
    found = collect(run)
    assert [each.name for each in found.evaluations] == ["last", "other"] and list(found.curves) == ["run"]
    assert main([str(run), "replay=false"]) == 0


def test_a_run_without_evaluation_has_its_curves(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("seed: 0\n")
    (tmp_path / "metrics.csv").write_text(METRICS)
    assert main([str(tmp_path)]) == 0
    text = (tmp_path / "report.html").read_text()
    assert "No evaluation yet" in text and 'data-figure="curve-return"' in text


def _without(path: Path, policy: str) -> None:
    lines = (path / "rows.csv").read_text().splitlines()
    (path / "rows.csv").write_text("\n".join(line for line in lines if f",{policy}," not in line) + "\n")


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda path: (path / "manifest.json").unlink(), "is not a results folder"),
        (lambda path: [file.unlink() for file in path.iterdir()], "holds no results"),
        (lambda path: (path / "rows.csv").unlink(), "has no episodes yet"),
        (lambda path: (path / "rows.csv").write_text("policy\nhuman\n"), "lacks the column"),
        (lambda path: _without(path, "human"), "has no rows of human"),
        (lambda path: _without(path, "uncommanded"), "has no rows of uncommanded"),
    ],
)
def test_other_folders_are_refused_in_one_sentence(break_it, message: str, tmp_path: Path, refused: Refused) -> None:
    path = folder(tmp_path / "results", table({"glide": (0.03, 0.0, 1)}))
    break_it(path)
    refused(main, [str(path)], message)
    assert not (path / "report.html").exists()


def test_results_that_are_not_complete_are_refused_unless_asked_for(tmp_path: Path, refused: Refused) -> None:
    path = folder(tmp_path / "results", table({"glide": (0.03, 0.0, 1)}), complete=False)
    refused(main, [str(path)], "is not finished")
    assert main([str(path), "partial=true", "replay=false"]) == 0
    assert "is not complete" in (path / "report.html").read_text()


def test_a_foreign_file_is_not_overwritten_but_a_report_is(results: Path, tmp_path: Path, refused: Refused) -> None:
    thesis, page = tmp_path / "thesis.html", tmp_path / "page.html"
    thesis.write_text("<!doctype html>\nfour years of work")
    refused(main, [str(results), f"out={thesis}", "replay=false"], "thesis.html exists and is not a report")
    assert "four years of work" in thesis.read_text()
    for title in ("one", "two"):
        assert main([str(results), f"out={page}", f"title={title}", "replay=false"]) == 0
    assert "<title>two" in page.read_text()
