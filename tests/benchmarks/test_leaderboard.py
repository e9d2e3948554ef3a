"""Leaderboard files: written from rows, checked against themselves, merged with their marks."""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from rich.console import Console

from izoo import leaderboard as command
from izoo.benchmarks.outcome import other_environment
from izoo.commands.leaderboards import leaderboard_table
from izoo.envs.config import EnvConfig, RewardConfig
from izoo.errors import IzooError
from izoo.evaluation.across import aggregate, run_rows
from izoo.evaluation.provenance import versions
from izoo.reporting.histogram_picture import histogram_panels
from izoo.reporting.standing import labels, published_for, standing
from izoo.reporting.submissions import (
    check,
    content_hash,
    headline,
    make_submission,
    merge,
    read_submission,
    schema,
    write_submission,
)
from tests.metrics.tables import seeds_table

VERSIONS = {"izoo": "1", "sumo": "1.28.0", "neuralmoves": "0.4", "code": "c" * 64}
PROTOCOL = {
    "protocol": "in_distribution",
    "title": "mine -> mine",
    "scale": "paper",
    "train": "mine",
    "test": None,
    "form": "split",
    "weather": None,
    "test_set": "grid",
    "horizon_s": 1000.0,
    "test_count": 3,
}
SAVED = {"a/1/A": 0.9, "b/1/A": 0.95, "c/1/A": 1.2}
"""Emission of the policy over that of the baseline, by context."""


def table(train_seed: int, contexts: tuple[str, ...] = tuple(SAVED)) -> pd.DataFrame:
    """Evaluation rows of one training seed; context ``b`` loses a vehicle and is gated."""
    parts = []
    for name in contexts:
        crossed = [10, 11, 12]
        human = [100.0 * n for n in crossed]
        kept = [9, 11, 12] if name.startswith("b") else crossed
        saved = SAVED[name] + 0.01 * train_seed
        for policy, count, grams in (("human", crossed, human), ("ppo", kept, [saved * 100.0 * n for n in kept])):
            rows = seeds_table(count, grams, policy=policy, context=name)
            parts.append(rows.assign(context_hash=hashlib.sha256(name.encode()).hexdigest()))
    return pd.concat(parts, ignore_index=True)


def submission(contexts: tuple[str, ...] = tuple(SAVED), **policy: Any) -> dict[str, Any]:
    rows = pd.concat([run_rows(table(k, contexts), "ppo", k) for k in range(4)], ignore_index=True)
    about = {"name": "ppo", "kind": "trained", "algo": "ppo", "action": "direct", "frames": 1000, **policy}
    return make_submission(about, PROTOCOL, VERSIONS, range(3), rows)


def sealed(content: dict[str, Any]) -> dict[str, Any]:
    """The content with the hash that belongs to it, as someone who tampers would write it."""
    return {**content, "hash": content_hash(content)}


def marks(content: dict[str, Any]) -> tuple[str, ...]:
    return check(content, "file", VERSIONS).marks


def test_an_honest_submission_survives_the_file(tmp_path: Path) -> None:
    content = submission()
    write_submission(tmp_path / "ppo.json", content)
    read = read_submission(tmp_path / "ppo.json")
    assert read == json.loads(json.dumps(content))
    checked = check(read, "ppo.json", VERSIONS)
    assert checked.marks == () and checked.notes == ()


def test_a_file_without_figures_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty.json").write_text(json.dumps(sealed({**submission(), "aggregates": {}})))
    assert command.main(["merge", str(tmp_path / "empty.json"), "--out", str(tmp_path / "board.json")]) == 2
    assert "empty.json" in capsys.readouterr().err and not (tmp_path / "board.json").exists()


def test_aggregates_keep_training_seeds_apart() -> None:
    rows = pd.concat([run_rows(table(k), "ppo", k) for k in range(4)], ignore_index=True)
    found = aggregate(rows)
    assert found["n"] == {
        "train_seeds": 4,
        "approaches": 3,
        "saturated": 0,
        "left_out": 0,
        "intersections": 3,
        "eval_seeds": 3,
    }
    exact = [run["exact"]["mean"] for run in found["per_seed"]]
    assert exact == pytest.approx([(0.1 - 0.01 * k + 0.0 - 0.2 - 0.01 * k) / 3 for k in range(4)])
    assert found["best_seed"]["seed"] == 0 and "paper's form" in found["best_seed"]["label"]
    mean = found["all"]["exact"]["mean"]
    assert mean["value"] == pytest.approx(sum(exact) / 4) and (mean["n"], mean["seeds"]) == (3, 4)
    assert mean["low"] is None and mean["missing"].startswith("no interval: 3 intersections")
    assert found["all"]["exact"]["share_gated"]["value"] == pytest.approx(1 / 3)
    assert found["unsaturated"] == found["all"]
    assert aggregate(rows) == found


def test_a_file_that_was_changed_is_marked() -> None:
    content = submission()
    renamed = {**content, "policy": {**content["policy"], "name": "mine"}}
    assert marks(renamed) == ("the hash does not match: the file was changed after it was written",)


def test_figures_and_seeds_that_the_rows_do_not_bear_out_are_marked() -> None:
    better, more, fewer = submission(), submission(), submission()
    better["aggregates"]["all"]["exact"]["mean"]["value"] += 0.01
    more["train_seeds"] = [*more["train_seeds"], 99]
    for row in fewer["rows"]:
        row["seeds"] = 2
    assert marks(sealed(better)) == ("the aggregates do not follow from the rows",)
    assert marks(sealed(more)) == (f"train_seeds are {more['train_seeds']}, the rows have {more['train_seeds'][:-1]}",)
    assert "2 evaluation seeds; the protocol asks for 3" in marks(sealed(fewer))
    with pytest.raises(IzooError, match=r"file lacks or repeats approaches; .* each once per training seed\."):
        check(sealed({**submission(), "rows": submission()["rows"][:-1]}), "file", VERSIONS)


def test_what_is_ranked_follows_from_the_rows() -> None:
    honest, better = submission(), submission(name="better")
    better["aggregates"]["all"]["exact"]["mean"]["value"] = 0.99
    (group,) = merge([check(sealed(content), "file", VERSIONS) for content in (better, honest)])["groups"]
    values = [headline(line)["value"] for line in (*group["ranked"], *group["marked"])]
    assert values[0] == values[1] == honest["aggregates"]["all"]["exact"]["mean"]["value"]


def test_what_is_missing_or_of_other_versions_is_marked() -> None:
    assert marks(submission(contexts=("a/1/A",))) == ("2 of 3 test contexts are missing",)
    other = submission()
    other["versions"]["sumo"] = "1.27.0"
    assert marks(sealed(other)) == ("other version of sumo: 1.27.0, not 1.28.0",)
    other = submission()
    other["eval_seeds"] = other["eval_seeds"][:2]
    assert marks(sealed(other)) == ("2 evaluation seeds; the protocol asks for 3",)


def test_another_environment_is_marked() -> None:
    assert other_environment(EnvConfig(horizon_s=300.0, reward=RewardConfig(eta=0.5), watchdog_s=5.0)) == ""
    own = EnvConfig(hold_s=2.0, neighbours=("leader",), observed=("green_s",), num_agents=32)
    assert other_environment(own) == "", "what a policy looks at, and how often it decides, are its own"
    changed = other_environment(EnvConfig(step_s=1.0, warmup_s=100.0))
    assert changed == "step_s 0.5 -> 1.0, warmup_s 25.0 -> 100.0"
    content = submission()
    content["protocol"]["env"] = changed
    assert marks(sealed(content)) == (f"evaluated in another environment: {changed}",)


def test_only_what_sumo_played_is_ranked() -> None:
    honest = submission()
    assert honest["simulator"] == "sumo" and marks(honest) == ()
    older = {key: value for key, value in honest.items() if key != "simulator"}
    assert marks(sealed(older)) == ()
    assert marks(sealed({**honest, "simulator": "twin"})) == ("played on the twin; only what SUMO played is ranked",)


def test_merging_ranks_the_unmarked_and_keeps_the_others_apart() -> None:
    good, marked = submission(), submission(contexts=("a/1/A",), name="lucky")
    worse = submission(name="worse")
    worse["rows"] = [{**row, **_shifted(row)} for row in worse["rows"]]
    worse["aggregates"] = aggregate(pd.DataFrame(worse["rows"]))
    other = sealed({**submission(), "protocol": {**PROTOCOL, "horizon_s": 500.0}})
    contents = (("w", sealed(worse)), ("l", marked), ("g", good), ("o", other))
    merged = merge([check(content, name, VERSIONS) for name, content in contents])
    first, second = merged["groups"]
    assert [(line["source"], line["rank"]) for line in first["ranked"]] == [("g", 1), ("w", 2)]
    assert [line["source"] for line in first["marked"]] == ["l"] and "rank" not in first["marked"][0]
    assert [line["source"] for line in second["ranked"]] == ["o"]
    json.dumps(merged, allow_nan=False)


def _shifted(row: dict[str, Any]) -> dict[str, Any]:
    """The row with half as much again emitted."""
    grams = 1.5 * row["emission_policy_g"]
    benefit = 1.0 - grams / row["emission_baseline_g"]
    gated = {f"benefit_{gate}": 0.0 if row[f"gated_{gate}"] else benefit for gate in ("exact", "tested")}
    return {"emission_policy_g": grams, "benefit_ungated": benefit, **gated}


def test_the_form_is_checked(tmp_path: Path) -> None:
    from jsonschema import Draft202012Validator

    Draft202012Validator.check_schema(schema())
    content = submission()
    content["rows"][1]["throughput_policy"] = -1
    del content["versions"]["sumo"]
    (tmp_path / "bad.json").write_text(json.dumps(content))
    with pytest.raises(IzooError, match=r"bad\.json is no leaderboard submission: rows/1/throughput_policy.*1 more"):
        read_submission(tmp_path / "bad.json")
    whole = json.dumps(submission())
    emission = f'"emission_policy_g": {submission()["rows"][0]["emission_policy_g"]}'
    infinite = [whole.replace(emission, f'"emission_policy_g": {word}', 1) for word in ("NaN", "1e999")]
    for text in ('{"format": "izoo', *infinite):
        assert text != whole
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(IzooError, match="cannot read"):
            read_submission(tmp_path / "bad.json")


def test_numbers_beyond_anything_measured_are_refused(tmp_path: Path) -> None:
    content = submission()
    content["rows"][2]["benefit_ungated"] = -1e308
    (tmp_path / "bad.json").write_text(json.dumps(content))
    with pytest.raises(IzooError, match=r"rows/2/benefit_ungated: -1e\+308 is beyond 1e\+15"):
        read_submission(tmp_path / "bad.json")


@pytest.mark.parametrize("column", ["benefit_exact", "benefit_region_exact", "throughput_benefit", "served_policy"])
def test_a_figure_that_rows_lack_is_lacking_in_the_sums(column: str, tmp_path: Path) -> None:
    content = submission()
    content["rows"][0][column] = None
    checked = check(sealed(content), "file", VERSIONS)
    assert "the aggregates do not follow from the rows" in checked.marks
    json.dumps(merge([checked]), allow_nan=False)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content = submission()
    here = versions()
    content["versions"] = {name: here[name] for name in VERSIONS}
    write_submission(tmp_path / "in" / "ppo.json", sealed(content))
    assert command.main(["validate", str(tmp_path / "in")]) == 0
    assert "ppo.json: in order" in capsys.readouterr().out
    out = tmp_path / "leaderboard.json"
    assert command.main(["merge", str(tmp_path / "in" / "ppo.json"), "--out", str(out)]) == 0
    assert json.loads(out.read_text())["groups"][0]["ranked"][0]["policy"]["name"] == "ppo"
    assert "mine -> mine" in capsys.readouterr().out
    content["versions"]["sumo"] = "1.0"
    write_submission(tmp_path / "in" / "old.json", sealed(content))
    assert command.main(["validate", str(tmp_path / "in")]) == 1
    assert "mark: other version of sumo" in capsys.readouterr().out
    assert command.main(["validate", str(tmp_path / "nothing.json")]) == 2
    assert command.main(["merge", str(out), "--out", str(out)]) == 2
    assert "no leaderboard submission" in capsys.readouterr().err
    inside = tmp_path / "in" / "leaderboard.json"
    for _ in range(2):
        assert command.main(["merge", str(tmp_path / "in"), "--out", str(inside)]) == 0
    assert command.main(["merge", str(tmp_path / "in"), "--out", str(tmp_path / "all.json")]) == 0, "it is passed over"
    inside.unlink()
    assert command.main(["merge", str(tmp_path / "in"), "--out", str(tmp_path / "in" / "ppo.json")]) == 2
    assert "ppo.json is there and is no merged leaderboard" in capsys.readouterr().err


HOSTILE = "[red]ppo[/red] [/nonsense] \x1b[2J\x1b]0;mine\x07\u202eoppo [link=http://x]"


def test_names_and_titles_are_shown_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Neither Rich nor the terminal obeys what somebody wrote into a submission."""
    content = submission(name=HOSTILE)
    content["protocol"]["title"] = HOSTILE
    write_submission(tmp_path / "hostile.json", sealed(content))
    assert command.main(["validate", str(tmp_path)]) in (0, 1)
    assert command.main(["merge", str(tmp_path), "--out", str(tmp_path / "leaderboard")]) == 0
    shown = capsys.readouterr()
    assert "Traceback" not in shown.err and not {"\x1b", "\x07", "\u202e"} & set(shown.out)
    assert "[red]ppo[/red]" in "".join(shown.out.split()) and "\\x1b" in shown.out


def test_the_table_fits_a_terminal_of_80_columns() -> None:
    """Names may be folded; figures, however wide, and headers may not."""
    contents = [submission(name=name) for name in ("measured_search_untrained", "ppo", "older")]
    wide = {"value": -1.2345, "low": -2.4056, "high": -1.0789}
    for part in contents[0]["aggregates"]["all"].values():
        part.get("mean", {}).update(wide)
    contents[0]["aggregates"]["all"] |= {
        f"{form}over_uncommanded": {"mean": wide} for form in ("", "region_", "demand_")
    }
    del contents[2]["aggregates"]["all"]["demand_exact"]
    text = printed(contents)
    assert text.count("-123.4 % [-240.6, -107.9]") == 6 and " ppo " in text
    assert [text.count(label) for label in ("to stop line", "whole region", "whole demand")] == [3, 3, 2]
    contents[1]["aggregates"]["all"] |= {
        "demand_exact": {"mean": {"value": 0.1223, "low": -0.0556, "high": 0.1884}},
        "demand_over_uncommanded": {"mean": {"value": -0.2424, "low": -0.4052, "high": -0.0792}},
    }
    assert "\n 3 approaches on SUMO " in printed(contents[1:2]), "no line is broken at the usual widths"


def printed(contents: list[dict[str, Any]]) -> str:
    """The table of submissions, with the figures they state, on a terminal of 80 columns, on which it must fit."""
    (group,) = merge([check(sealed(content), "file", VERSIONS) for content in contents])["groups"]
    stated = {content["policy"]["name"]: content["aggregates"] for content in contents}
    for line in (*group["ranked"], *group["marked"]):
        line["aggregates"] = stated[line["policy"]["name"]]
    shown, out = leaderboard_table(group), io.StringIO()
    Console(file=out, width=80).print(shown)
    text = out.getvalue()
    assert "\u2026" not in text and all(len(line) <= 80 for line in text.splitlines())
    assert all(word in text for column in shown.columns for word in str(column.header).splitlines())
    return text


def test_a_leaderboard_is_drawn_beside_what_was_published(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    entries = [submission(), submission(name="glide", kind="scripted"), submission(name="$odd_untrained$")]
    for content in entries:
        content["protocol"] = {**PROTOCOL, "title": "a -> a", "train": "salt_lake_city"}
    checked = [check(sealed(content), f"{k}.json", VERSIONS) for k, content in enumerate(entries)]
    left, right = standing(merge(checked)).axes
    assert [label.get_text() for label in left.get_yticklabels()] == ["ppo", "$odd untrained$", "glide"]
    merged = merge(checked)
    merged["groups"][0]["ranked"][0]["n"] = {**entries[0]["aggregates"]["n"], "approaches": 106}
    titles = [standing(each).axes[0].get_title(loc="left") for each in (merge(checked), merged)]
    assert [title.partition("; ")[2] for title in titles] == [
        f"{n} approaches, training seeds: 4" for n in ("3", "3 to 106")
    ]
    longer = [{"policy": {**content["policy"], "frames": 244_000}} for content in entries[:2]]
    assert labels([*entries, *longer])[-2:] == ["ppo, 244,000 decisions", "glide"]
    dots = [line for line in right.lines if line.get_marker() == "o"]
    rows = pd.concat([run_rows(table(k), "ppo", k) for k in range(4)], ignore_index=True)
    wanted = 100 * aggregate(rows)["all"]["exact"]["ratio_of_sums"]["value"]
    assert [float(dot.get_xdata()[0]) for dot in dots] == pytest.approx([wanted] * 3)
    published = [line for line in right.lines if line.get_marker() == "D"]
    assert [(line.get_xdata()[0], line.get_ydata()[0]) for line in published] == [(pytest.approx(-9.59), 0)]
    assert [each.algorithm for each in published_for(entries[0]["protocol"])] == ["DDPG", "PPO"]
    assert published_for({**PROTOCOL, "protocol": "systematicity"}) == []
    published = published_for({**PROTOCOL, "protocol": "systematicity"}, "at_zero")
    assert [(each.algorithm, each.at_zero) for each in published] == [("DDPG", 40), ("PPO", 119)]
    write_submission(tmp_path / "ppo.json", entries[0])
    assert command.main(["draw", str(tmp_path / "ppo.json"), "--out", str(tmp_path / "all.png")]) == 0
    assert (tmp_path / "all.png").read_bytes().startswith(b"\x89PNG")
    assert command.main(["draw", str(tmp_path / "ppo.json"), "--out", str(tmp_path / "no" / "all.png")]) == 2
    assert "choose another file with --out" in capsys.readouterr().err
    assert command.main(["draw", str(tmp_path / "ppo.json"), "--out", str(tmp_path / "all.pdf")]) == 2
    assert "is a PNG" in capsys.readouterr().err and not (tmp_path / "all.pdf").exists()


def test_histograms_show_every_approach_of_every_seed(tmp_path: Path) -> None:
    content = submission()
    content["protocol"] = {**PROTOCOL, "title": "a -> a", "train": "salt_lake_city"}
    checked = check(sealed(content), "ppo.json", VERSIONS)
    panels = histogram_panels([checked] * 3).axes
    assert [bool(panel.patches) for panel in panels] == [True, True, True, False]
    rows = [row for row in content["rows"] if not row["left_out"]]
    heights, cut = [bar.get_height() for bar in panels[0].patches], panels[0].texts
    written = sum(int(text.get_text()) for text in cut[:-1])
    assert sum(heights) - (len(cut) - 1) * max(heights) * bool(written) + written == len(rows)
    at_zero = sum(0.0 <= 100.0 * row["benefit_exact"] < 200.0 / 150 for row in rows)
    assert cut[-1].get_text().splitlines() == [
        f"at 0: {at_zero} of {len(rows)} ({100.0 * at_zero / len(rows):.0f} %)",
        "published: 913 of 1048 (87 %)",
    ]
    write_submission(tmp_path / "ppo.json", content)
    out = tmp_path / "histograms.png"
    assert command.main(["draw", str(tmp_path / "ppo.json"), "--histograms", "--out", str(out)]) == 0
    assert out.read_bytes().startswith(b"\x89PNG")


def test_files_from_before_there_was_a_benefit_by_demand_still_count() -> None:
    """Their rows lack the columns, their aggregates the part; the picture leaves its marker out."""
    content = submission()
    assert "demand_exact" in content["aggregates"]["all"]
    for row in content["rows"]:
        for name in [name for name in row if "demand_" in name]:
            del row[name]
        row["benefit_over_uncommanded"] = row["benefit_region_over_uncommanded"] = 0.01
    rows = pd.DataFrame(content["rows"])
    content["aggregates"] = {**content["aggregates"], **aggregate(rows)}
    checked = check(sealed(content), "old.json", VERSIONS)
    assert not checked.marks and "demand_exact" not in content["aggregates"]["all"]
    left, _ = standing(merge([checked])).axes
    assert [text.get_text() for text in left.get_legend().get_texts()] == ["to the stop line", "whole region"]
