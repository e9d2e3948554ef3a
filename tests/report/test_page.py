"""The page of real results: whole, self-contained, and honest about what it lacks."""

from __future__ import annotations

import base64
import dataclasses
import gzip
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pandas as pd
import pytest

from izoo.conf.compose import compose_config
from izoo.conf.report_options import ReportConfig
from izoo.evaluation.table import FEATURES
from izoo.report import COMMAND, main
from izoo.reporting.material import Entry, Evaluated, Material, collect
from izoo.reporting.page import render
from izoo.reporting.results import EntryRecord, RunRecord, read_results, write_results
from izoo.reporting.scored import improvement, score
from tests.evaluation.test_summary import make_table
from tests.reporting.made_results import METRICS, benchmark, rename_policy

VOID = {"meta", "link", "input"}
HOSTILE = "<script>alert(1)</script>"


class Balance(HTMLParser):
    """Raises where tags do not nest; counts the elements."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.count: dict[str, int] = {}

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.count[tag] = self.count.get(tag, 0) + 1
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def content_of(page: Path) -> dict:
    """What the page's scripts draw."""
    packed = re.search(r'id="content-pack">([^<]*)<', page.read_text())
    assert packed is not None
    return json.loads(gzip.decompress(base64.b64decode(packed[1])))


def test_page_of_an_evaluation(page: Path, evaluation: Path) -> None:
    text = page.read_text()
    parser = Balance()
    parser.feed(text)
    assert parser.open == []
    assert parser.count["script"] == 5  # the library, the content, two replays, and the program
    assert not re.search(r"""<[^>]*\s(src|href)=["'](?!#|data:)""", text)
    assert page.stat().st_size < 3_000_000
    content = content_of(page)
    assert content["rows"]["policy"] == ["glide"] * 2 + ["uncommanded"] * 2
    assert [scene["which"] for scene in content["scenes"]] == ["best", "worst"]
    assert {"forest", "profiles", "histogram-0", "histogram-1", "published"} == set(content["figures"])
    assert all(figure["alt"] for figure in content["figures"].values())
    assert "-1.85 %" in text
    assert "248 of 1048" in text
    for words in (
        "whole region: mean",
        "region, over uncommanded",
        "demand served",
        "kept out",
        "fewer than 6 intersections",
    ):
        assert words in text


def test_the_same_results_give_the_same_page(page: Path, evaluation: Path, tmp_path: Path, capsys) -> None:
    again = tmp_path / "new" / "page.html"
    assert main([str(evaluation), f"out={again}"]) == 0
    assert again.read_bytes() == page.read_bytes()
    assert "Replaying" not in capsys.readouterr().out  # they lie in the folder


def test_names_from_files_stay_text(evaluation: Path, tmp_path: Path) -> None:
    folder = rename_policy(evaluation, tmp_path / "results", "glide", HOSTILE)
    assert main([str(folder), f"title={HOSTILE}", "replay=false"]) == 0
    text = (folder / "report.html").read_text()
    assert HOSTILE not in text
    assert "<h1>&lt;script&gt;alert(1)&lt;/script&gt;</h1>" in text
    figures = json.dumps(content_of(folder / "report.html")["figures"]["forest"]["data"])
    assert "<script" not in figures


def test_page_of_a_benchmark(evaluation: Path, tmp_path: Path) -> None:
    folder = benchmark(evaluation, tmp_path / "results")
    assert main([str(folder)]) == 0
    text = (folder / "report.html").read_text()
    assert "<h1>here -&gt; there</h1>" in text
    assert "best of 2 seeds (the paper&#39;s form)" in text
    # Weights that are not there cannot be replayed, which is said; scripted drivers can.
    assert "holds no checkpoint" in text
    content = content_of(folder / "report.html")
    assert {scene["name"] for scene in content["scenes"]} == {"glide"}
    assert {"curve-validation-0", "curve-return", "histogram-0-best"} <= set(content["figures"])
    rows = content["rows"]
    runs = dict(zip(rows["policy"], rows["runs"], strict=True))
    assert runs == {"ppo": 2, "glide": 1, "uncommanded": 1}
    ours = [b for name, b in zip(rows["policy"], rows["benefit_ungated"], strict=True) if name == "ppo"]
    glide = [b for name, b in zip(rows["policy"], rows["benefit_ungated"], strict=True) if name == "glide"]
    # One run emits as glide does, the other nine tenths of it; the mean of both is shown.
    assert ours == pytest.approx([1.0 - 0.95 * (1.0 - b) for b in glide], abs=1e-5)


def test_weights_before_training_are_neither_replayed_nor_chosen_from(evaluation: Path, tmp_path: Path) -> None:
    """``ppo_untrained`` has a run per training seed, like ``ppo``, but nothing that was trained."""
    folder = benchmark(evaluation, tmp_path / "results")
    runs = []
    for seed in (0, 1):
        where = f"evaluation/ppo_untrained/seed{seed}"
        rename_policy(evaluation, folder / where, "glide", "ppo_untrained")
        runs.append(RunRecord(seed, "done", where))
    results = read_results(folder)
    untrained = EntryRecord("ppo_untrained", "scripted", "ppo", "direct", tuple(runs))
    write_results(folder, dataclasses.replace(results, entries=(untrained, *results.entries)))
    assert main([str(folder)]) == 0
    text = (folder / "report.html").read_text()
    assert text.count("<small>best of 2 seeds (the paper&#39;s form)</small>") == 1  # of ppo
    assert "No replay of ppo_untrained" not in text and "No replay of ppo:" in text
    content = content_of(folder / "report.html")
    assert {scene["name"] for scene in content["scenes"]} == {"glide"}
    lines = {trace["name"]: trace["line"]["dash"] for trace in content["figures"]["profiles"]["data"]}
    assert [lines[name] for name in lines if name.startswith(("ppo_untrained", "uncommanded"))] == ["dot", "dot"]


def test_the_headline_says_where_commands_were_nan(evaluation: Path, tmp_path: Path) -> None:
    """What SUMO drove in a policy's place must not pass for its benefit."""
    folder = benchmark(evaluation, tmp_path / "all")
    assert 'class="warning" role="note"' not in render(collect(folder), replay=False)
    path = folder / "evaluation/ppo/seed1/evaluation.csv"
    table = pd.read_csv(path, dtype={"seed": str})
    own = table["policy"] == "ppo"
    table.loc[own, "nan_actions"] = table.loc[own, "agent_steps"] // 2
    table.to_csv(path, index=False)
    commands = 2 * table.loc[own, "agent_steps"].sum()
    share = f"{100 * table.loc[own, 'nan_actions'].sum() / commands:.3g} %"
    text = render(collect(folder), replay=False)
    warnings = re.findall(r'class="warning" role="note">([^<]*)<', text)
    assert warnings == [f"ppo: {share} of its commands were NaN; SUMO drove those vehicles."]
    assert re.findall(r"<small>([^<]*)of its commands NaN</small>", text) == [f"{share} "]


def test_page_of_a_run_without_evaluation(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.yaml").write_text("seed: 0\n")
    (run / "metrics.csv").write_text(METRICS)
    assert main([str(run)]) == 0
    text = (run / "report.html").read_text()
    assert "No evaluation yet" in text
    assert 'data-figure="curve-return"' in text


def test_page_of_a_run_with_the_evaluation_that_ended_it(evaluation: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(evaluation, tmp_path / "run"))
    (run / "config.yaml").write_text("seed: 0\n")
    (run / "metrics.csv").write_text(METRICS)
    material = collect(run)
    assert {entry.name for entry in material.entries} == {"glide", "uncommanded"}
    assert [curve.name for curve in material.curves] == ["run"]
    shutil.copytree(evaluation, run / "evaluations" / "other")
    manifest = run / "evaluations" / "other" / "evaluation.json"
    content = json.loads(manifest.read_text())
    content["settings"]["env"]["horizon_s"] = 77.0
    manifest.write_text(json.dumps(content))
    material = collect(run)
    scored = {entry.name: score(entry) for entry in material.entries}
    assert scored.keys() >= {"glide on training contexts", "glide on other", "uncommanded on other"}
    assert "; 77 s" in dict(material.facts)["episode"], "the facts of each evaluation are stated"
    # Policies of one evaluation are paired, those of different ones are not.
    assert improvement(scored["glide on other"], scored["uncommanded on other"]) is not None
    assert improvement(scored["glide on other"], scored["glide on training contexts"]) is None


def made(table: pd.DataFrame) -> Material:
    """Return what a report is made of, from an evaluation's table."""
    table = table.assign(**{name: 1.0 for name in FEATURES if name not in table})
    names = [name for name in dict.fromkeys(table["policy"]) if name != "human"]
    entries = []
    for name in names:
        rows = table[table["policy"].isin(["human", "uncommanded", name])]
        entries.append(Entry(name, name, "test", (Evaluated(0, Path("nowhere"), rows),)))
    return Material("title", "evaluation", tuple(entries))


def test_measured_quantities_are_those_of_the_episodes_that_all_policies_have() -> None:
    """Human driving too: elsewhere it burns twice as much, and the policy, which was not there, would seem to save."""
    table = make_table()
    elsewhere = table["context"].str.startswith("town/5")
    table.loc[elsewhere, "emission_g"] *= 2.0
    table = table[~elsewhere | (table["policy"] != "ppo")]
    there = table[(table["policy"] == "human") & ~elsewhere]
    shared, every = (
        f"{t['emission_g'].sum() / t['crossed'].sum():.4g}" for t in (there, table.query("policy == 'human'"))
    )
    text = render(made(table), replay=False)
    assert f"<td>{shared}</td>" in text and f"<td>{every}</td>" not in text


def test_policies_without_a_common_episode_stand_in_tables_of_their_own() -> None:
    table = make_table()
    first = table["context"].str.startswith("town/0")
    table = table[(table["policy"] != "ppo") | first]
    table = table[(table["policy"] != "uncommanded") | ~first]
    table = pd.concat([table, table[table["policy"] == "uncommanded"].assign(policy="mine")])  # beside it
    text = render(made(table), replay=False)
    part = text[text.index("Everything that was measured") :]
    part = part[: part.index("</details>")]
    assert part.count("<table>") == 2 and part.count(">human<") == 2


def test_benefits_of_electric_vehicles_are_over_human_driving_as_well() -> None:
    material = made(make_table("electric"))
    ppo = score(next(entry for entry in material.entries if entry.name == "ppo")).summary["all"]
    assert ppo["ungated"]["mean"]["value"] == pytest.approx(0.1)
    assert ppo["over_uncommanded"]["mean"]["value"] == pytest.approx(1.0 - 0.9 / 0.97)
    words = "Controlled vehicles are electric"
    assert words in render(material, replay=False)
    assert words not in render(made(make_table()), replay=False)


def test_paired_seeds_are_those_of_all_evaluations(evaluation: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(evaluation, run / "evaluations" / "other")
    (run / "config.yaml").write_text("seed: 0\n")
    shutil.copytree(evaluation, run, dirs_exist_ok=True)
    table = pd.read_csv(run / "evaluation.csv", dtype={"seed": str})
    table[table["seed"] == table["seed"].iloc[0]].to_csv(run / "evaluation.csv", index=False)
    assert "1 to 2 paired seeds each" in render(collect(run), replay=False)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("train/ppo/seed0/metrics.csv", "-30.5", "many"),
        ("train/ppo/seed0/metrics.csv", "1000,10", "soon,10"),
        ("train/ppo/seed0/validation.csv", "0.05", "good"),
    ],
)
def test_tables_of_runs_with_other_things_than_numbers_are_refused(
    evaluation: Path, tmp_path: Path, capsys, name: str, old: str, new: str
) -> None:
    path = benchmark(evaluation, tmp_path / "results") / name
    path.write_text(path.read_text().replace(old, new))
    assert main([str(tmp_path / "results"), "replay=false"]) == 2
    assert f"cannot read {path}" in capsys.readouterr().err


def test_page_of_tradeoffs(tmp_path: Path, capsys) -> None:
    header = "point,train_seed,kind,emission_g_per_vehicle,travel_time_s_per_vehicle,throughput_kept"
    (tmp_path / "tradeoffs.csv").write_text(f"{header}\nhuman,,human,100,40,True\n")
    assert main([str(tmp_path)]) == 2
    assert "lacks the column(s) on_front" in capsys.readouterr().err
    (tmp_path / "tradeoffs.csv").write_text(f"{header},on_front\nhuman,,human,100,40,True,True\n")
    assert main([str(tmp_path)]) == 0
    assert 'data-figure="pareto"' in (tmp_path / "report.html").read_text()
    for row, column in (
        ("human,,human,much,40,True,True", "emission_g_per_vehicle"),
        ("human,,human,1,4,True,", "on_front"),
    ):
        (tmp_path / "bad").mkdir(exist_ok=True)
        (tmp_path / "bad" / "tradeoffs.csv").write_text(f"{header},on_front\n{row}\n")
        assert main([str(tmp_path / "bad")]) == 2
        assert f"is damaged in the column {column}" in capsys.readouterr().err
    assert "pareto" in content_of(tmp_path / "report.html")["figures"]


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda folder: shutil.rmtree(folder), "is no folder"),
        (lambda folder: [path.unlink() for path in folder.iterdir() if path.is_file()], "holds no results"),
        (lambda folder: (folder / "evaluation.csv").unlink(), "has no evaluation.csv"),
        (lambda folder: (folder / "evaluation.json").unlink(), "has no evaluation.json"),
        (lambda folder: (folder / "evaluation.json").write_text("{"), "is damaged"),
        (lambda folder: _rename_key(folder / "evaluation.json", "policies"), "is damaged"),
        (lambda folder: (folder / "evaluation.csv").write_text("policy\nhuman\n"), "lacks the column"),
        (lambda folder: (folder / "evaluation.partial.jsonl").write_text("[]\n"), "interrupted"),
        (lambda folder: (folder / "results.json").write_text('{"format": "other"}'), "another version"),
        (lambda folder: _drop_rows(folder, "human"), "no rows of human driving"),
    ],
)
def test_half_written_and_foreign_folders_are_refused(
    evaluation: Path, tmp_path: Path, capsys, break_it, message: str
) -> None:
    folder = tmp_path / "results"
    shutil.copytree(evaluation, folder)
    (folder / "report.html").unlink(missing_ok=True)
    break_it(folder)
    before = sorted(tmp_path.rglob("*"))
    assert main([str(folder)]) == 2
    assert message in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


def _rename_key(path: Path, key: str) -> None:
    path.write_text(path.read_text().replace(f'"{key}"', '"other"'))


def _drop_rows(folder: Path, policy: str) -> None:
    lines = (folder / "evaluation.csv").read_text().splitlines()
    (folder / "evaluation.csv").write_text("\n".join(line for line in lines if not line.startswith(policy)) + "\n")


def test_a_foreign_file_is_not_overwritten_but_a_report_is(evaluation: Path, tmp_path: Path, capsys) -> None:
    thesis, page = tmp_path / "thesis.html", tmp_path / "page.html"
    thesis.write_text("<!doctype html>\nfour years of work")
    assert main([str(evaluation), f"out={thesis}", "replay=false"]) == 2
    assert "thesis.html exists and is no report" in capsys.readouterr().err
    assert "four years of work" in thesis.read_text()
    results = Path(shutil.copytree(evaluation, tmp_path / "results"))
    shutil.copyfile(thesis, results / "report.html")  # where it would go by itself
    assert main([str(results), "replay=false"]) == 2
    assert "four years of work" in (results / "report.html").read_text()
    for title in ("one", "two"):
        assert main([str(evaluation), f"out={page}", f"title={title}", "replay=false"]) == 0
    assert "<title>two" in page.read_text()


def test_an_unfinished_benchmark_is_refused_unless_asked_for(evaluation: Path, tmp_path: Path, capsys) -> None:
    folder = benchmark(evaluation, tmp_path / "results", status="training")
    assert main([str(folder)]) == 2
    assert "ppo seed 1 (training)" in capsys.readouterr().err
    assert not (folder / "report.html").exists()
    assert main([str(folder), "partial=true", "replay=false"]) == 0
    assert "Unfinished: ppo seed 1 (training)" in (folder / "report.html").read_text()


@pytest.mark.parametrize("place", ["../{name}", "{absolute}"])
def test_an_index_does_not_lead_out_of_its_folder(evaluation: Path, tmp_path: Path, capsys, place: str) -> None:
    folder = benchmark(evaluation, tmp_path / "results")
    outside = shutil.copytree(evaluation, tmp_path / "outside")
    before = sorted(outside.rglob("*"))
    index = folder / "results.json"
    named = place.format(name="outside", absolute=outside)
    index.write_text(index.read_text().replace("evaluation/glide/seed0", named))
    assert main([str(folder)]) == 2
    assert "outside of the folder" in capsys.readouterr().err
    assert sorted(outside.rglob("*")) == before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "give one folder"),
        (["a", "b"], "give one folder"),
        (["a", "repaly=true"], "repaly"),
        (["a", "replay=perhaps"], "perhaps"),
        (["a", "--out"], "--out"),
    ],
)
def test_bad_options_are_refused(words: list[str], message: str, capsys) -> None:
    assert main(words) == 2
    assert message in capsys.readouterr().err


def test_options() -> None:
    words = ["results", "out=a=b.html", "title=one -> 'two', three", "replay=false", "imports=true"]
    config = compose_config("report", ReportConfig, COMMAND.options(words))
    assert COMMAND.options(["results=a"]) == COMMAND.options(["a"]) == ["results='a'"]
    assert config == ReportConfig("results", "a=b.html", "one -> 'two', three", replay=False, imports=True)
    assert compose_config("report", ReportConfig, COMMAND.options(["results", "title=null"])).title is None
