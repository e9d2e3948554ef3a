"""Leaderboard files as a table in Markdown, and the pages of results, whose tables are what the command prints."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from izoo import leaderboard as command
from izoo.reporting.markdown_table import COLUMNS
from izoo.reporting.submissions import content_hash
from tests.docs.blocks import DOCS

FILES = DOCS / "leaderboard"
LONG = FILES / "5000_episodes"
LEARNERS = ("ppo", "mappo", "gcrl", "ddpg")
TABLES: dict[str, list[Path]] = {
    "results": [FILES, *(LONG / f"{name}.json" for name in LEARNERS)],
    "without blinkers": [
        *(FILES / "without_blinkers" / f"{name}.json" for name in (*LEARNERS, "ppo_5000")),
        Path("--uncommanded"),
        FILES / "uncommanded.json",
    ],
    "without blinkers in atlanta": [
        *(FILES / "without_blinkers" / f"{name}_atlanta.json" for name in (*LEARNERS, "ppo_5000")),
        Path("--uncommanded"),
        FILES / "atlanta" / "uncommanded.json",
    ],
    "without blinkers, trained in atlanta": [
        *(FILES / "without_blinkers" / f"{name}_atlanta_in_distribution.json" for name in LEARNERS),
        Path("--uncommanded"),
        FILES / "atlanta" / "uncommanded.json",
    ],
    "without blinkers, all approaches": [
        FILES / "without_blinkers" / "ppo_5000_all_approaches.json",
        Path("--uncommanded"),
        FILES / "all_approaches" / "uncommanded.json",
    ],
    "all approaches": [FILES / "all_approaches", FILES / "5000_episodes_all_approaches"],
    "atlanta": [FILES / "atlanta", *(LONG / f"{name}_atlanta.json" for name in LEARNERS)],
    "atlanta, all approaches": [FILES / "atlanta_all_approaches"],
    "atlanta in distribution": [
        FILES / "atlanta_in_distribution",
        Path("--uncommanded"),
        FILES / "atlanta" / "uncommanded.json",
    ],
    "systematicity": [FILES / "systematicity"],
    "measured": [FILES / "measured"],
    "paper presets": [FILES / "paper_presets", Path("--uncommanded"), FILES / "uncommanded.json"],
}
"""What the command is given for each table of the pages, by the comment before it."""
Run = Callable[..., tuple[int, str, str]]


@functools.cache
def pages() -> str:
    return "".join((DOCS / name).read_text() for name in ("benchmark.md", "notes/results.md"))


def test_the_page_says_how_many_simulators_the_files_came_from() -> None:
    codes = {json.loads(path.read_text())["versions"]["code"] for path in FILES.rglob("*.json")}
    assert f"The files carry {len(codes)} different digests" in (DOCS / "benchmark.md").read_text()


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def table(*words: object) -> tuple[int, str, str]:
        code = command.main(["table", *map(str, words)])
        return code, *capsys.readouterr()

    return table


def row(text: str, entry: str) -> dict[str, str]:
    """The cells of the first row of an entry, by column."""
    line = next(line for line in text.splitlines() if line.startswith(f"| {entry} |"))
    return dict(zip(COLUMNS, line.removeprefix("| ").removesuffix(" |").split(" | "), strict=True))


def changed(path: Path, where: Path, change: Callable[[dict[str, Any]], object], sealed: bool = True) -> Path:
    """A copy of a leaderboard file in another folder, with a change, and the hash that belongs to it."""
    content = json.loads(path.read_text())
    change(content)
    copy = where / path.name
    copy.write_text(json.dumps({**content, "hash": content_hash(content)} if sealed else content))
    return copy


@pytest.mark.parametrize("name", TABLES)
def test_the_pages_show_what_the_command_prints(name: str, run: Run) -> None:
    (shown,) = re.findall(rf"<!-- {name} -->\n(.*?)\n<!-- end of {name} -->", pages(), re.DOTALL)
    code, printed, _ = run(*TABLES[name])
    assert code == 0
    assert printed.splitlines() == shown.splitlines()


def test_every_table_of_this_kind_is_checked() -> None:
    assert pages().count(f"| {' | '.join(COLUMNS)} |") == len(TABLES)
    there = {path for path in FILES.rglob("*.json") if path.parent.name != "64_episodes"}
    named = [path for paths in TABLES.values() for path in paths if path.exists()]
    assert there == {file for path in named for file in (path.glob("*.json") if path.is_dir() else [path])}


def test_a_table_without_uncommanded_cvs_is_refused(run: Run) -> None:
    code, printed, said = run(FILES / "atlanta_in_distribution")
    assert (code, printed) == (2, "")
    assert said == (
        "izoo leaderboard: none of the files is that of uncommanded CVs, with which the table compares; add "
        "uncommanded.json, or name it with --uncommanded if it is to have no row.\n"
    )
    code, _, said = run(FILES / "glide.json", "--uncommanded", FILES / "ppo.json")
    assert code == 2 and "the file of ppo; give that of uncommanded CVs" in said
    code, _, said = run(FILES / "uncommanded.json", "--uncommanded", FILES / "uncommanded.json")
    assert code == 2 and "give only one" in said


def test_files_of_other_episodes_are_refused(run: Run, tmp_path: Path) -> None:
    reference = FILES / "uncommanded.json"
    code, printed, said = run(reference, FILES / "all_approaches" / "glide.json")
    assert (code, printed) == (2, "") and "tested on different approaches" in said
    fewer = changed(FILES / "glide.json", tmp_path, lambda content: content["rows"].pop())
    code, _, said = run(reference, fewer)
    assert code == 2 and "tested on different approaches" in said
    busier = changed(
        FILES / "glide.json", tmp_path, lambda content: content["rows"][3].update(throughput_baseline=1000.0)
    )
    code, _, said = run(reference, busier)
    assert code == 2 and "human driving differs" in said


@pytest.mark.parametrize("change", [lambda rows: rows.pop(), lambda rows: rows.append(rows[0])])
def test_every_training_seed_has_every_approach_once(
    change: Callable[[list[Any]], object], run: Run, tmp_path: Path
) -> None:
    other = changed(FILES / "ppo.json", tmp_path, lambda content: change(content["rows"]))
    code, _, said = run(FILES / "uncommanded.json", other)
    assert code == 2 and "each once per training seed" in said


def test_a_file_that_was_changed_by_hand_is_refused(run: Run, tmp_path: Path) -> None:
    better = changed(
        FILES / "glide.json", tmp_path, lambda content: content["rows"][0].update(benefit_exact=0.9), sealed=False
    )
    code, printed, said = run(FILES / "uncommanded.json", better)
    assert (code, printed) == (2, "") and "glide.json was changed after it was written" in said


def test_figures_follow_the_rows(run: Run, tmp_path: Path) -> None:
    """Not the aggregates that somebody wrote beside them; of what is kept out there are none."""

    def change(content: dict[str, Any]) -> None:
        content["aggregates"]["all"]["exact"]["mean"]["value"] = 0.9
        for line in content["rows"]:
            line["kept_out_policy"] = min(line["kept_out_policy"] + 0.02, 1.0)

    _, before, _ = run(FILES / "uncommanded.json", FILES / "ppo.json")
    _, after, _ = run(FILES / "uncommanded.json", changed(FILES / "ppo.json", tmp_path, change))
    assert row(before, "PPO")["kept out, over uncommanded"] == "+0.2 [0.0, 0.4]"
    assert row(after, "PPO") == {**row(before, "PPO"), "kept out, over uncommanded": "+2.2 [2.0, 2.4]"}


def test_files_of_earlier_versions_leave_cells_empty(run: Run) -> None:
    """As those of 64 episodes, which lack what is by demand and what is kept out."""
    code, printed, _ = run(FILES / "64_episodes")
    assert code == 0
    cells = row(printed, "DDPG")
    empty = {"whole demand, over uncommanded", "kept out, over uncommanded"}
    assert {name for name, cell in cells.items() if not cell} == empty
    assert cells["over uncommanded"] == "-0.3 [-3.7, 3.1]" and cells["training"] == "29,280"
    assert [line.split(" | ")[0] for line in printed.splitlines()[-2:]] == ["| DDPG, untrained", "| `city`, untrained"]


def test_a_name_cannot_break_the_table(run: Run, tmp_path: Path) -> None:
    odd = changed(FILES / "glide.json", tmp_path, lambda content: content["policy"].update(name="a | `b`\n<i>"))
    code, printed, _ = run(FILES / "uncommanded.json", odd)
    lines = printed.splitlines()
    assert code == 0 and len(lines) == 4
    assert lines[-1].startswith("| `a \\| 'b'\\n<i>` |")
    assert {line.replace("\\|", "").count("|") for line in lines} == {len(COLUMNS) + 1}
