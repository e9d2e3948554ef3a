"""Paired episodes on the real simulator: the same for any number of workers, resumed, cached, and failing loudly."""

from __future__ import annotations

import dataclasses
import io
import json
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
from pandas.testing import assert_frame_equal
from rich.console import Console

from izoo.algos.scripted import UncommandedDriver
from izoo.contexts.context import Context
from izoo.errors import IzooError
from izoo.evaluation import approach_table, evaluate_policy, print_summary, summarise
from izoo.evaluation.baselines import EpisodeCache, baseline_context
from izoo.evaluation.folder import ResultFolder
from izoo.evaluation.processes import EpisodeFailed
from izoo.evaluation.table import COLUMNS, read_csv
from izoo.metrics.definitions import APPROACH_METRICS
from izoo.reporting.material import collect
from tests.evaluation import odd_policies as drivers
from tests.evaluation.conftest import SHORT

SEEDS = [11, 12]
STEPS = SHORT.control_steps


@pytest.fixture(scope="module")
def table(contexts: list[Context], cache: Path) -> pd.DataFrame:
    """``gentle`` and its baselines, played in this process."""
    return evaluate_policy(drivers.gentle, contexts, SEEDS, SHORT, num_workers=0, progress=False, cache=cache)


def test_one_row_per_policy_context_seed_and_approach(table: pd.DataFrame, contexts: list[Context]) -> None:
    assert list(table.columns) == list(COLUMNS)
    assert len(table) == 3 * len(contexts) * len(SEEDS)
    assert set(table["policy"]) == {"human", "uncommanded", "policy"}
    assert set(table["approach"]) == {contexts[0].approach}
    assert not table.duplicated(["policy", "context_hash", "seed", "approach"]).any()
    assert (table["episode_steps"] == STEPS).all()
    assert (table["entered"] > 0).all()
    assert (table.loc[table["policy"] == "human", "agent_steps"] == 0).all()
    assert (table.loc[table["policy"] == "policy", "agent_steps"] > 0).any()


@pytest.mark.slow
def test_rows_do_not_depend_on_the_workers(table: pd.DataFrame, contexts: list[Context], tmp_path: Path) -> None:
    """Two processes and a cold cache against one process."""
    other = evaluate_policy(
        drivers.gentle, contexts, SEEDS, SHORT, num_workers=2, progress=False, cache=tmp_path / "cold", out_dir=tmp_path
    )
    # Compiled code that was loaded and code that was compiled just now may round the last bit of an emission otherwise.
    assert_frame_equal(other, table, rtol=1e-6)
    counts = ["entered", "crossed", "vehicle_steps", "stopped_time_s", "agent_steps", "deferred_steps"]
    assert_frame_equal(other[counts], table[counts], check_exact=True)
    assert_frame_equal(read_csv(tmp_path / "evaluation.csv"), other, check_exact=True)
    assert json.loads((tmp_path / "summary.json").read_text()) == summarise(other)
    assert not (tmp_path / "evaluation.partial.jsonl").exists()


SCRIPT = """
import torch
from izoo.contexts.procedural import procedural_context
from izoo.envs import EnvConfig
from izoo.evaluation import evaluate_policy

print("begins")

class Steady(torch.nn.Module):
    def forward(self, tensordict):
        return tensordict.set(("agents", "action"), torch.ones(*tensordict["agents", "mask"].shape, 1))

config = EnvConfig(horizon_s=10.0, warmup_s=5.0)
table = evaluate_policy(Steady(), [procedural_context(adoption=1.0)], [1, 2], config, num_workers=1, cache="cache")
print("rows", len(table))
"""


@pytest.mark.slow
def test_a_script_needs_no_main_guard(tmp_path: Path) -> None:
    """Workers do not run the user's script again, and classes that it defines reach them."""
    (tmp_path / "script.py").write_text(SCRIPT)
    done = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("begins") == 1
    assert "rows 6" in done.stdout
    assert "Traceback" not in done.stderr


def test_random_driver_is_reproducible_in_any_order(contexts: list[Context], cache: Path) -> None:
    options = {"num_workers": 0, "progress": False, "cache": cache, "uncommanded": False}
    forward = evaluate_policy("random", contexts, SEEDS, SHORT, **options)
    backward = evaluate_policy("random", contexts[::-1], SEEDS[::-1], SHORT, **options)
    assert_frame_equal(forward, backward, check_exact=True)


@pytest.mark.parametrize("make", [drivers.Tiring, drivers.Remembering, drivers.Drawing, drivers.Numpy])
def test_no_policy_plays_otherwise_for_what_it_played_before(
    make: type, contexts: list[Context], cache: Path, tmp_path: Path
) -> None:
    """One that counts, one with memory, and one that draws from a generator of its own or of numpy."""
    options = {"progress": False, "cache": cache, "uncommanded": False}
    forward = evaluate_policy(make(), contexts, SEEDS, SHORT, num_workers=0, **options)
    backward = evaluate_policy(make(), contexts[::-1], SEEDS[::-1], SHORT, num_workers=0, **options)
    assert_frame_equal(forward, backward, check_exact=True)
    assert (forward.loc[forward["policy"] == "policy", "deferred_steps"] > 0).any(), "the policy acted"


def test_recurrent_policies_keep_what_they_write_for_the_next_step(contexts: list[Context], cache: Path) -> None:
    seen: list[tuple[bool, float | None]] = []
    drivers.Recurrent.seen = seen
    for _ in range(2):
        evaluate_policy(drivers.Recurrent(), contexts[:1], SEEDS[:1], SHORT, num_workers=0, progress=False, cache=cache)
    first, second = seen[:STEPS], seen[STEPS:]
    assert first == second == [(True, None), *((False, float(step)) for step in range(1, STEPS))]


def test_modules_are_played_as_they_evaluate(contexts: list[Context], cache: Path) -> None:
    policy = drivers.Moody().train()
    table = evaluate_policy(policy, contexts[:1], SEEDS[:1], SHORT, num_workers=0, progress=False, cache=cache)
    assert policy.training, "the caller's own is left as it is"
    gentle = evaluate_policy(drivers.gentle, contexts[:1], SEEDS[:1], SHORT, 0, progress=False, cache=cache)
    assert_frame_equal(table, gentle, check_exact=True)


def test_an_identical_policy_has_exactly_no_benefit(contexts: list[Context], cache: Path) -> None:
    """Nobody commands under another name: the numbers of the uncommanded CV, and both gates passed."""
    table = evaluate_policy(
        UncommandedDriver(), contexts, [1, 2, 3], SHORT, num_workers=0, progress=False, cache=cache, name="twin"
    )
    result = approach_table(table, "twin", "uncommanded")
    assert len(result) == len(contexts)
    assert (result[["benefit_exact", "benefit_tested", "throughput_benefit"]] == 0.0).all(axis=None)
    assert not result[["gated_exact", "gated_tested"]].any(axis=None)
    assert result[["low", "high"]].isna().all(axis=None)


def test_human_driving_does_not_depend_on_what_concerns_cvs(contexts: list[Context], cache: Path) -> None:
    changed = contexts[0].replace(adoption=0.8, engine="electric", cv_vehicle="human")
    assert baseline_context(changed) == baseline_context(contexts[0])
    table = evaluate_policy("human", [contexts[0], changed], [3], SHORT, num_workers=0, progress=False, cache=cache)
    human = table[table["policy"] == "human"]
    assert human["context_hash"].nunique() == 2
    assert human[list(APPROACH_METRICS)].drop_duplicates().shape[0] == 1
    plain = evaluate_policy(
        UncommandedDriver(), [changed.replace(adoption=0.0)], [3], SHORT, 0, None, False, name="x", cache=cache
    )
    played = plain[plain["policy"] == "x"][list(APPROACH_METRICS)].to_numpy()
    assert (played == human[list(APPROACH_METRICS)].to_numpy()[:1]).all()


def test_all_approach_contexts_report_every_approach(contexts: list[Context], cache: Path) -> None:
    whole = contexts[0].replace(approach=None)
    table = evaluate_policy("constant", [whole], [5], SHORT, num_workers=0, progress=False, cache=cache)
    rows = table[table["policy"] == "constant"]
    assert rows["approach"].tolist() == list(whole.intersection.approach_names)
    assert (rows["demand"] == "all").all()
    assert (rows["entered"] > 0).all()


def test_nan_actions_are_counted_and_driven_by_idm(table: pd.DataFrame, contexts: list[Context], cache: Path) -> None:
    lost = evaluate_policy(drivers.lost, contexts[:1], SEEDS, SHORT, num_workers=0, progress=False, cache=cache)
    chosen, reference = (lost[lost["policy"] == name] for name in ("policy", "uncommanded"))
    assert (chosen["nan_actions"] == chosen["agent_steps"]).all()
    assert (chosen["nan_actions"] > 0).any()
    assert (chosen["emission_g"].to_numpy() == reference["emission_g"].to_numpy()).all()
    summary = summarise(lost)
    assert summary["scores"]["policy"]["nan_share"] == 1.0
    console = Console(file=io.StringIO(), width=200)
    print_summary(summary, console)
    assert "policy: 100 % of its commands were NaN; SUMO drove those vehicles." in console.file.getvalue()
    shown = " ".join(console.file.getvalue().split())
    assert "policy against human on SUMO (headline); 100 % of the commands NaN, driven by SUMO" in shown
    assert "uncommanded: 0 %" not in shown and "uncommanded against human;" not in shown


def test_an_interrupted_evaluation_goes_on_where_it_stopped(
    table: pd.DataFrame, contexts: list[Context], cache: Path, tmp_path: Path
) -> None:
    policy = drivers.Counted(tmp_path / "steps", fail_at=3 * STEPS)
    options = {"num_workers": 0, "progress": False, "cache": cache, "out_dir": tmp_path / "out"}
    with pytest.raises(EpisodeFailed, match=rf"context {contexts[1].name}, seed {SEEDS[1]}.*out of luck"):
        evaluate_policy(policy, contexts, SEEDS, SHORT, **options)
    kept = read_csv(tmp_path / "out" / "evaluation.csv")
    assert (kept["policy"] == "policy").sum() == 3
    with pytest.raises(IzooError, match="interrupted"):
        collect(tmp_path / "out")
    policy.limit.write_text(str(10**9))
    resumed = evaluate_policy(policy, contexts, SEEDS, SHORT, **options)
    assert policy.steps() == 4 * STEPS
    assert_frame_equal(resumed, table, check_exact=True)
    assert collect(tmp_path / "out")
    evaluate_policy(policy, contexts, SEEDS, SHORT, **options)
    assert policy.steps() == 4 * STEPS


def test_a_torn_journal_loses_only_its_last_line(contexts: list[Context], cache: Path, tmp_path: Path) -> None:
    policy = drivers.Counted(tmp_path / "steps")
    options = {"num_workers": 0, "progress": False, "cache": cache, "out_dir": tmp_path / "out"}
    whole = evaluate_policy(policy, contexts[:1], SEEDS, SHORT, **options)
    rows = json.loads(whole[whole["policy"] == "policy"].to_json(orient="records"))
    (tmp_path / "out" / "evaluation.csv").unlink()
    journal = tmp_path / "out" / "evaluation.partial.jsonl"
    journal.write_text(json.dumps(rows[:1]) + "\n" + json.dumps(rows[1:])[:50])
    again = evaluate_policy(policy, contexts[:1], SEEDS, SHORT, **options)
    assert policy.steps() == 3 * STEPS
    assert (again["policy"] == "policy").sum() == 2
    assert not journal.exists()


def test_other_weights_replace_the_rows_of_that_name_only(contexts: list[Context], cache: Path, tmp_path: Path) -> None:
    options = {"num_workers": 0, "progress": False, "cache": cache, "out_dir": tmp_path, "name": "mine"}
    first = evaluate_policy(drivers.gentle, contexts[:1], SEEDS[:1], SHORT, **options)
    second = evaluate_policy(drivers.lost, contexts[:1], SEEDS[:1], SHORT, **options)
    assert len(first) == len(second) == 3
    assert second.loc[second["policy"] == "mine", "nan_actions"].sum() > 0
    both = evaluate_policy("constant", contexts[:1], SEEDS[:1], SHORT, **{**options, "name": None})
    assert set(both["policy"]) == {"human", "uncommanded", "mine", "constant"}


def test_a_folder_of_other_settings_is_refused_and_says_which(
    contexts: list[Context], cache: Path, tmp_path: Path
) -> None:
    options = {"num_workers": 0, "progress": False, "cache": cache, "out_dir": tmp_path}
    evaluate_policy("human", contexts[:1], SEEDS[:1], SHORT, **options)
    before = (tmp_path / "evaluation.csv").read_bytes()
    with pytest.raises(IzooError, match=r"env\.step_s 0\.5 -> 1\.0"):
        evaluate_policy("human", contexts[:1], SEEDS[:1], dataclasses.replace(SHORT, step_s=1.0), **options)
    assert (tmp_path / "evaluation.csv").read_bytes() == before


def test_baselines_are_played_once(contexts: list[Context], cache: Path, table: pd.DataFrame) -> None:
    """The cache answers: an entry that was altered comes back as it is."""
    entries = EpisodeCache(cache, SHORT)
    played = baseline_context(contexts[0])
    rows = entries.get("human", played, SEEDS[0])
    assert rows is not None
    assert entries.get("human", played, 10**6) is None
    other = EpisodeCache(cache / "other", SHORT)
    other.put("human", played, SEEDS[0], [{**row, "crossed": 12345.0} for row in rows])
    again = evaluate_policy(
        "human", contexts[:1], SEEDS[:1], SHORT, 0, None, False, cache=cache / "other", uncommanded=False
    )
    assert again["crossed"].tolist() == [12345.0]


@pytest.mark.parametrize(
    ("policy", "num_workers", "error", "message"),
    [
        pytest.param(
            drivers.broken, 1, EpisodeFailed, "ArithmeticError: the driver fell asleep", marks=pytest.mark.slow
        ),
        (drivers.broken, 0, EpisodeFailed, "ArithmeticError: the driver fell asleep"),
        (drivers.silent, 0, IzooError, "action"),
        pytest.param(drivers.deadly, 1, EpisodeFailed, "lost 2 times.*SIGKILL", marks=pytest.mark.slow),
    ],
)
def test_a_failing_episode_names_its_context(
    policy, num_workers: int, error: type[Exception], message: str, contexts: list[Context], cache: Path
) -> None:
    with pytest.raises(error, match=rf"(?s)context {contexts[0].name}, seed {SEEDS[0]}.*{message}"):
        evaluate_policy(
            policy, contexts[:1], SEEDS[:1], SHORT, num_workers, progress=False, cache=cache, uncommanded=False
        )


@pytest.mark.parametrize(
    ("policy", "name", "message"),
    [
        ("glied", None, "Did you mean 'glide'"),
        ("no_such_module:f", None, "module:function"),
        ("./mine.py:drive", None, "is no policy: it is written module:function, such as mine:drive"),
        (":drive", None, "module:function"),
        ("os:", None, "module:function"),
        ("os:sep", None, "is a str; name a function"),
        ("tests.evaluation.odd_policies:nobody", None, "nobody"),
        (drivers.gentle, "human", "another name"),
        (3, None, "int is no policy"),
    ],
)
def test_policies_that_cannot_be_used_are_refused(policy, name: str | None, message: str, easy: Context) -> None:
    with pytest.raises(IzooError, match=message):
        evaluate_policy(policy, [easy], [0], SHORT, num_workers=0, name=name)


def test_nothing_to_evaluate_is_refused(easy: Context) -> None:
    with pytest.raises(IzooError, match="one or more"):
        evaluate_policy("human", [easy], [], SHORT)


def test_rows_of_other_weights_are_forgotten_before_anything_is_played(table: pd.DataFrame, tmp_path: Path) -> None:
    rows = table[table["policy"] == "policy"].to_dict("records")

    def opened(fingerprint: str, new: list[dict]) -> set[tuple[str, str, int]]:  # type: ignore[type-arg]
        folder = ResultFolder(tmp_path, {"env": {}})
        with folder.open("policy", fingerprint):
            found = set(folder.done)
            folder.add(new)
        return found

    assert opened("old", rows) == set()
    assert len(opened("old", [])) == len(rows)
    assert opened("new", []) == set()
    assert opened("new", []) == set(), "the first weights' rows came back as those of the second"


def test_an_evaluation_that_is_begun_again_and_killed_still_counts_as_interrupted(
    table: pd.DataFrame, tmp_path: Path
) -> None:
    rows = table[table["policy"] == "policy"].to_dict("records")
    folder = ResultFolder(tmp_path, {"env": {}})
    with pytest.raises(KeyboardInterrupt), folder.open("policy", "f"):
        folder.add(rows[:1])
        raise KeyboardInterrupt
    again = ResultFolder(tmp_path, {"env": {}})
    begun = again.open("policy", "f")
    begun.__enter__()  # and then nothing more, as where the process is killed
    with pytest.raises(IzooError, match="interrupted"):
        collect(tmp_path)
    begun.__exit__(None, None, None)
    assert not (tmp_path / "evaluation.partial.jsonl").exists()


def test_uncommanded_cvs_are_a_baseline_where_they_played_every_episode(table: pd.DataFrame) -> None:
    some = table[(table["policy"] != "uncommanded") | (table["seed"] == SEEDS[0])]
    against = [summarise(t)["policies"]["policy"]["against"] for t in (table, some)]
    assert [set(found) for found in against] == [{"human", "uncommanded"}, {"human"}]
    assert "over_uncommanded" in against[0]["human"]["all"] and "over_uncommanded" not in against[1]["human"]["all"]
    assert against[0]["human"]["all"]["exact"] == against[1]["human"]["all"]["exact"]


def test_policies_that_change_lanes_meet_baselines_that_do_as_sumo_has_it(contexts: list[Context], cache: Path) -> None:
    changing = dataclasses.replace(SHORT, lane_change=True)
    tables = [
        evaluate_policy(drivers.leftwards, contexts[:1], [11], config, 0, progress=False, cache=cache)
        for config in (changing, SHORT)
    ]
    for name in ("human", "uncommanded"):
        one, other = (table[table["policy"] == name].reset_index(drop=True) for table in tables)
        assert_frame_equal(one[list(APPROACH_METRICS)], other[list(APPROACH_METRICS)])


@pytest.mark.slow
def test_a_stopped_process_is_replaced_in_the_time_of_the_watchdog(
    contexts: list[Context], cache: Path, tmp_path: Path
) -> None:
    """It has ended afterwards, and its episode was played by another."""
    config = dataclasses.replace(SHORT, watchdog_s=3.0)
    policy = drivers.Stopping(tmp_path / "stopped")
    begin = time.monotonic()
    table = evaluate_policy(policy, contexts[:1], SEEDS, config, num_workers=2, progress=False, cache=cache)
    assert (tmp_path / "stopped").exists() and time.monotonic() - begin < 120.0
    gentle = evaluate_policy(drivers.gentle, contexts[:1], SEEDS, config, num_workers=0, progress=False, cache=cache)
    columns = ["policy", *APPROACH_METRICS]
    assert_frame_equal(table[columns], gentle[columns])
    assert not [child for child in own_children() if stopped(child)]


def own_children() -> list[int]:
    """Processes that this one has started."""
    tasks = Path("/proc/self/task").iterdir()
    return [int(pid) for task in tasks for pid in (task / "children").read_text().split()]


def stopped(pid: int) -> bool:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"
