"""Leaderboard files: written from rows, checked, ranked, converted, and refused in one sentence."""

import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from jsonschema import Draft202012Validator
from matplotlib import image

from izoo import leaderboard as command
from izoo.envs import MODEL_VERSION
from izoo.envs.mdp.metric_sums import APPROACH_METRICS
from izoo.errors import IzooError
from izoo.metrics.summary import summarise
from izoo.report import leaderboard
from izoo.report.leaderboard import board, check, content_hash, make_entry, merge, read_entry, unpacked, write_entry
from izoo.results.store import read_table
from tests.conftest import Refused
from tests.report.made_tables import PPO, SEVERAL, folder, table


def content(made: pd.DataFrame | None = None, **policy: Any) -> dict[str, Any]:
    made = table({"ppo": PPO}) if made is None else made
    return make_entry({"name": "ppo", "kind": "trained", **policy}, "town test", MODEL_VERSION, {"izoo": "1"}, made)


def sealed(changed: dict[str, Any]) -> dict[str, Any]:
    """The content with the hash that belongs to it, as someone who tampers would write it."""
    return {**changed, "hash": content_hash(changed)}


def marks(changed: dict[str, Any]) -> tuple[str, ...]:
    return check(changed, unpacked(changed["rows"]), "file").marks


@pytest.fixture
def results(tmp_path: Path) -> Path:
    return folder(tmp_path / "results", table(SEVERAL))


def test_an_entry_survives_its_file(results: Path) -> None:
    paths = leaderboard.write_entries(results)
    assert [path.name for path in paths] == ["cap_0.6.json", "glide.json", "ppo.json"]
    entry = read_entry(paths[-1])
    assert entry.marks == () and entry.notes == ()
    summaries = [summarise(rows)["entries"]["ppo"] for rows in (entry.table, table({"ppo": PPO}))]
    found, wanted = (of["against"]["uncommanded"]["unsaturated"]["figures"] for of in summaries)
    for key, estimate in wanted.items():
        assert found[key]["value"] == pytest.approx(estimate["value"], rel=1e-5, abs=1e-5)
    assert set(APPROACH_METRICS) <= set(entry.table)


def test_files_are_ranked_and_slower_entries_come_last(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    leaderboard.write_entries(results)
    out = results / "board.json"
    assert command.main(["validate", str(results / "leaderboard")]) == 0
    assert command.main(["merge", str(results / "leaderboard"), "--out", str(out)]) == 0
    assert command.main(["merge", str(results / "leaderboard"), "--out", str(out)]) == 0, "it may be written again"
    (group,) = json.loads(out.read_text())["groups"]
    assert [(line["name"], line["rank"]) for line in group["entries"]] == [("ppo", 1), ("glide", 2), ("cap_0.6", 3)]
    assert [row.label for _, rows in board(group).groups for row in rows][-1] == "cap_0.6"
    assert "slower" in capsys.readouterr().out
    assert command.main(["table", str(results / "leaderboard")]) == 0
    printed = capsys.readouterr().out
    title, _, rows = printed.partition("\n\n")
    assert title.endswith("; played on SUMO:") and rows.startswith("| entry | CO2 saved |")
    assert printed.rstrip().endswith(group["summary"]["verdict"])
    assert command.main(["merge", str(out), "--out", str(results / "leaderboard" / "ppo.json")]) == 2
    picture = results / "all.png"
    assert command.main(["draw", str(results / "leaderboard"), "--out", str(picture)]) == 0
    assert image.imread(picture).shape[2] == 4


def test_what_is_wrong_with_a_file_is_a_mark() -> None:
    honest = content()
    assert marks(honest) == ()
    renamed = {**honest, "policy": {**honest["policy"], "frames": 1}}
    assert marks(renamed) == ("the hash does not match: the file was changed after it was written",)
    other = sealed({**honest, "model_version": MODEL_VERSION + 1})
    assert marks(other) == (f"model version {MODEL_VERSION + 1} of the simulation, not {MODEL_VERSION}",)
    made = table({"ppo": PPO})
    few = made.drop(made.index[(made["policy"] == "ppo") & (made["context_id"] == 3)])
    assert marks(content(few)) == ("rows of ppo are missing",)
    assert marks(content(made[made["policy"] != "human"])) == ("rows of human are missing",)
    each = table({"ppo": PPO}, seeds=4)
    each = each[(each["policy"] != "ppo") | (each["seed"] == each["train_seed"] + 1)]
    assert marks(content(each)) == (), "each training seed has played episodes of its own"
    first = each[(each["context_id"] != 3) | (each["seed"] != 1)]
    assert marks(content(first)) == ("rows of ppo are missing",), "seed 0 has left one out"
    picked = table({"ppo": PPO}, seeds=4)
    picked = picked[(picked["policy"] != "ppo") | (picked["seed"] != picked["train_seed"] + 1)]
    assert marks(content(picked)) == ("rows of ppo are missing",), "each seed has left out another one"
    few = check(content(table({"ppo": (0.06, -1.0, 2)})), table({"ppo": (0.06, -1.0, 2)}), "file")
    assert few.marks == () and few.notes == ("2 training seeds of 4",)


CONTRADICTIONS = {
    **{f"{part} is above {name}": {part: 1e9} for part, name in leaderboard.LIMITS},
    **{f"{name} is not {' + '.join(parts)}": {name: 1e9} for name, parts in leaderboard.WHOLES},
    "the cohort of an episode is not the same for all policies": {"cohort": 20.0, "cohort_left": 20.0},
}


@pytest.mark.parametrize("what", CONTRADICTIONS)
def test_rows_that_contradict_themselves_get_no_rank(what: str) -> None:
    """However the hash was made; one row is enough."""
    made = table({"ppo": PPO})
    row = made.index[made["policy"] == "ppo"][5]
    for name, value in CONTRADICTIONS[what].items():
        made.loc[row, name] = value
    assert f"rows contradict themselves: {what}" in marks(content(made))


def test_rows_that_were_played_do_not_contradict_themselves(evaluation: Path) -> None:
    assert leaderboard.contradictions(read_table(evaluation)) == []


def test_entries_that_cannot_be_compared_are_listed_without_rank() -> None:
    made = table({"ppo": PPO})
    contents = {
        "good": content(),
        "small": content(table({"ppo": PPO}, places=8), name="ppo"),
        "other": content(made.assign(cohort_region_co2_g=1.1 * made["cohort_region_co2_g"])),
    }
    found = [check(of, unpacked(of["rows"]), name) for name, of in contents.items()]
    (group,) = merge(found)["groups"]
    assert [(line["name"], line["source"], line["rank"], line["marks"]) for line in group["entries"]] == [
        ("ppo", "good", 1, []),
        ("ppo 2", "small", None, ["4 contexts fewer than others of the task"]),
        ("ppo 3", "other", None, ["its baselines drove otherwise than those of the other files"]),
    ]
    json.dumps(group, allow_nan=False)


def test_entries_of_another_model_or_simulator_are_ranked_among_themselves(tmp_path: Path, capsys: Any) -> None:
    write_entry(tmp_path / "new.json", content())
    write_entry(tmp_path / "twin.json", content(table({"ppo": PPO}).assign(simulator="twin")))
    write_entry(tmp_path / "old.json", sealed({**content(), "model_version": MODEL_VERSION + 1}))
    assert command.main(["validate", str(tmp_path)]) == 1
    assert command.main(["merge", str(tmp_path), "--out", str(tmp_path / "board")]) == 0
    groups = json.loads((tmp_path / "board").read_text())["groups"]
    assert [[line["rank"] for line in group["entries"]] for group in groups] == [[1], [1], [1]]
    assert [board(group).title.rpartition("; ")[2] for group in groups] == ["played on SUMO"] * 2 + [
        "played on the twin"
    ]
    assert f"model version {MODEL_VERSION + 1} of the simulation" in capsys.readouterr().out


def _column(name: str, values: Any) -> Any:
    return lambda of: {**of, "rows": {**of["rows"], name: values}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda of: {**of, "format": "other"}, "format: "),
        (lambda of: {**of, "policy": {"name": "x"}}, "policy: 'kind' is a required property"),
        (
            lambda of: {**of, "rows": {k: v for k, v in of["rows"].items() if k != "crossed"}},
            "the column(s) crossed are missing",
        ),
        (_column("crossed", [1.0, "many"]), "rows/crossed"),
        (_column("crossed", [1.0]), "columns have different lengths"),
        (_column("crossed", [1e300] * 72), "rows/crossed: a number is beyond"),
        (_column("policy", {"values": ["ppo"], "index": [7] * 72}), "rows/policy: an index is beyond the values"),
        (_column("policy", {"values": ["ppo"], "index": [0] * 72}), "an episode's approach is there twice"),
        (_column("crossed", {"values": ["a"], "index": [0] * 72}), "rows/crossed: could not convert"),
        (
            _column("simulator", {"values": ["carla"], "index": [0] * 72}),
            "rows/simulator: 'carla' is none of sumo, twin",
        ),
    ],
)
def test_bad_files_are_refused_in_one_sentence(change: Any, message: str, tmp_path: Path, refused: Refused) -> None:
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(sealed(change(content()))))
    assert "bad.json" in refused(command.main, ["merge", str(path), "--out", str(tmp_path / "board.json")], message)
    assert not (tmp_path / "board.json").exists()


@pytest.mark.parametrize("word", ["NaN", "1e999", "{"])
def test_what_is_not_json_is_refused(word: str, tmp_path: Path) -> None:
    write_entry(tmp_path / "bad.json", content())
    text = (tmp_path / "bad.json").read_text()
    (tmp_path / "bad.json").write_text(text.replace('"model_version":', f'"model_version":{word}', 1))
    with pytest.raises(IzooError, match="cannot read"):
        read_entry(tmp_path / "bad.json")
    Draft202012Validator.check_schema(leaderboard.schema())


HOSTILE = "[red]ppo[/red] [/nonsense] \x1b[2J\x1b]0;mine\x07\u202eoppo [link=http://x]"


def test_names_and_tasks_are_shown_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Neither Rich nor the terminal obeys what somebody wrote into a file."""
    made = table({HOSTILE: PPO}).assign(task=HOSTILE)
    write_entry(tmp_path / "h.json", make_entry({"name": HOSTILE, "kind": "trained"}, HOSTILE, MODEL_VERSION, {}, made))
    assert command.main(["validate", str(tmp_path)]) == 0
    assert command.main(["merge", str(tmp_path), "--out", str(tmp_path / "leaderboard")]) == 0
    assert command.main(["table", str(tmp_path)]) == 0
    shown = capsys.readouterr()
    assert "Traceback" not in shown.err and not {"\x1b", "\x07", "\u202e"} & set(shown.out)
    assert "[red]ppo[/red]" in "".join(shown.out.split()) and "\\x1b" in shown.out
