"""Paired episodes on the real simulator: the same for any number of workers, resumed, cached, and failing loudly."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from pandas.testing import assert_frame_equal

from izoo.algos.drivers.uncommanded import UncommandedDriver
from izoo.contexts.context import Context
from izoo.envs.mdp.metric_sums import APPROACH_METRICS
from izoo.errors import IzooError
from izoo.results import read_table, summarise
from izoo.results.cache import EpisodeCache, baseline_context
from izoo.results.playing import EpisodeFailed, Setup
from izoo.results.store import PolicyRecord, read_contexts, read_manifest
from tests.conftest import SHORT
from tests.results import odd_policies as drivers
from tests.results.conftest import SEEDS, Evaluate

STEPS = SHORT.control_steps


def test_one_row_per_policy_context_seed_and_approach(table: pd.DataFrame, contexts: list[Context]) -> None:
    assert len(table) == 3 * len(contexts) * len(SEEDS)
    assert set(table["policy"]) == {"human", "uncommanded", "policy"}
    assert set(table["approach"]) == {contexts[0].approach}
    assert (table["episode_steps"] > STEPS).all(), "they are played out"
    assert (table["cohort"] > 0).all()
    assert table.groupby(["context_hash", "seed"])["cohort"].nunique().max() == 1, "the same under every policy"
    assert (table.loc[table["policy"] == "human", "agent_steps"] == 0).all()
    assert (table.loc[table["policy"] == "policy", "agent_steps"] > 0).any()


@pytest.mark.slow
def test_rows_do_not_depend_on_the_workers(
    table: pd.DataFrame, contexts: list[Context], tmp_path: Path, evaluate: Evaluate
) -> None:
    """Two processes and a cold cache against one process."""
    other = evaluate(drivers.gentle, contexts, SEEDS, workers=2, cache=tmp_path / "cold", out=tmp_path / "out")
    # Compiled code that was loaded and code that was compiled just now may round the last bit of an emission otherwise.
    assert_frame_equal(other, table, rtol=1e-6)
    assert_frame_equal(read_table(tmp_path / "out"), other, check_exact=True)
    assert read_manifest(tmp_path / "out").complete
    assert set(read_contexts(tmp_path / "out")) == {context.content_hash for context in contexts}


SCRIPT = """
import torch
from izoo.contexts.procedural import procedural_context
from izoo.envs import EnvConfig
from izoo.results import evaluate_policy

print("begins")

class Steady(torch.nn.Module):
    def forward(self, tensordict):
        return tensordict.set(("agents", "action"), torch.ones(*tensordict["agents", "mask"].shape, 1))

config = EnvConfig(horizon_s=10.0, warmup_s=5.0)
table = evaluate_policy(Steady(), [procedural_context(adoption=1.0)], [1, 2], config, workers=1, cache="cache")
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


@pytest.mark.parametrize("make", [drivers.Tiring, drivers.Remembering, drivers.Drawing, drivers.Numpy, str])
def test_no_policy_plays_otherwise_for_what_it_played_before(
    make: type, contexts: list[Context], evaluate: Evaluate
) -> None:
    """One that counts, one with memory, and some that draw from a generator of their own, of numpy or of torch."""
    forward = evaluate(make() or "random", contexts, SEEDS, baselines=())
    backward = evaluate(make() or "random", contexts[::-1], SEEDS[::-1], baselines=())
    assert_frame_equal(forward, backward, check_exact=True)
    assert (forward["agent_steps"] > 0).any() and forward["episode_steps"].gt(0).all()


def test_recurrent_policies_keep_what_they_write_for_the_next_step(contexts: list[Context], evaluate: Evaluate) -> None:
    seen: list[tuple[bool, float | None]] = []
    drivers.Recurrent.seen = seen
    for _ in range(2):
        evaluate(drivers.Recurrent(), contexts[:1], SEEDS[:1])
    first, second = seen[: len(seen) // 2], seen[len(seen) // 2 :]
    assert first == second == [(True, None), *((False, float(step)) for step in range(1, len(first)))]


def test_modules_are_played_as_they_evaluate(contexts: list[Context], evaluate: Evaluate) -> None:
    policy = drivers.Moody().train()
    table = evaluate(policy, contexts[:1], SEEDS[:1])
    assert policy.training, "the caller's own is left as it is"
    gentle = evaluate(drivers.gentle, contexts[:1], SEEDS[:1])
    assert_frame_equal(table, gentle, check_exact=True)


def test_an_identical_policy_saves_exactly_nothing(contexts: list[Context], evaluate: Evaluate) -> None:
    """Uncommanded driving under another name."""
    summary = summarise(evaluate(UncommandedDriver(), contexts, [1, 2, 3], name="twin"))
    figures = summary["entries"]["twin"]["against"]["uncommanded"]["all"]["figures"]
    assert figures["co2_saved"]["value"] == figures["delay_change_s"]["value"] == 0.0


def test_a_drain_that_is_too_short_for_anybody_is_seen(contexts: list[Context], evaluate: Evaluate) -> None:
    config = dataclasses.replace(SHORT, horizon_s=25.0, drain_s=0.5)
    summary = summarise(evaluate("glide", contexts, [1], config=config))
    assert summary["entries"]["glide"]["levels"]["all"]["unserved"] == 100.0


def test_human_driving_does_not_depend_on_what_concerns_cvs(contexts: list[Context], evaluate: Evaluate) -> None:
    changed = contexts[0].replace(adoption=0.8, engine="electric", cv_vehicle="human")
    assert baseline_context(changed) == baseline_context(contexts[0])
    table = evaluate("human", [contexts[0], changed], [3])
    human = table[table["policy"] == "human"]
    assert human["context_hash"].nunique() == 2
    assert human[list(APPROACH_METRICS)].drop_duplicates().shape[0] == 1
    plain = evaluate(UncommandedDriver(), [changed.replace(adoption=0.0)], [3], name="x")
    played = plain[plain["policy"] == "x"][list(APPROACH_METRICS)].to_numpy()
    assert (played == human[list(APPROACH_METRICS)].to_numpy()[:1]).all()


def test_all_approach_contexts_report_every_approach(contexts: list[Context], evaluate: Evaluate) -> None:
    whole = contexts[0].replace(approach=None)
    table = evaluate("constant", [whole], [5])
    rows = table[table["policy"] == "constant"]
    assert rows["approach"].tolist() == list(whole.intersection.approach_names)
    assert (rows["demand"] == "all").all()
    assert (rows["entered"] > 0).all()


def test_an_interrupted_evaluation_goes_on_where_it_stopped(
    table: pd.DataFrame, contexts: list[Context], evaluate: Evaluate, tmp_path: Path
) -> None:
    policy = drivers.Counted(tmp_path / "steps", fail_at=3 * STEPS + 3)
    with pytest.raises(EpisodeFailed, match=r"policy policy, context .*, seed .*out of luck"):
        evaluate(policy, contexts, SEEDS, out=tmp_path / "out")
    kept = read_table(tmp_path / "out")
    finished = (kept["policy"] == "policy").sum()
    assert 1 <= finished < 4 and not read_manifest(tmp_path / "out").complete
    policy.limit.write_text(str(10**9))
    resumed = evaluate(policy, contexts, SEEDS, out=tmp_path / "out")
    assert_frame_equal(resumed, table, check_exact=True)
    steps = policy.steps()
    evaluate(policy, contexts, SEEDS, out=tmp_path / "out")
    assert policy.steps() == steps and read_manifest(tmp_path / "out").complete


def test_a_source_is_kept_relative_to_the_folder_that_a_link_leads_to(
    contexts: list[Context], evaluate: Evaluate, tmp_path: Path
) -> None:
    (tmp_path / "disk" / "results").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "disk" / "results")
    record = PolicyRecord("trained", source=str(tmp_path / "mine.pt"), algo="ppo", frames=7)
    options = {"record": record, "train_seed": 3, "out": tmp_path / "link", "name": "mine"}
    evaluate(drivers.Moody(), contexts[:1], SEEDS[:1], **options)
    (kept,) = read_manifest(tmp_path / "link").policies["mine"].items()
    assert kept[0] == 3 and (kept[1].source, kept[1].algo, kept[1].frames) == ("../../mine.pt", "ppo", 7)


def test_baselines_are_played_once(
    contexts: list[Context], cache: Path, table: pd.DataFrame, evaluate: Evaluate
) -> None:
    """The cache answers: an entry that was altered comes back as it is."""
    setup = Setup({}, dataclasses.replace(SHORT, emit=()))
    entries, played = EpisodeCache(cache, setup), baseline_context(contexts[0])
    found = entries.get("human", played, SEEDS[0])
    assert found is not None and entries.get("human", played, 10**6) is None
    assert entries.get("human", played, SEEDS[0], ["team_reward"]) is None, "it was not recorded"
    others = EpisodeCache(cache / "other", setup)
    others.put("human", played, SEEDS[0], found._replace(rows=[{**row, "crossed": 12345.0} for row in found.rows]))
    again = evaluate("human", contexts[:1], SEEDS[:1], cache=cache / "other", baselines=())
    assert again["crossed"].tolist() == [12345.0]


@pytest.mark.parametrize(
    ("policy", "workers", "error", "message"),
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
    policy, workers: int, error: type[Exception], message: str, contexts: list[Context], evaluate: Evaluate
) -> None:
    with pytest.raises(error, match=rf"(?s)context {contexts[0].name}, seed {SEEDS[0]}.*{message}"):
        evaluate(policy, contexts[:1], SEEDS[:1], workers=workers, baselines=())


@pytest.mark.parametrize(
    ("policy", "name", "message"),
    [
        ("glied", None, "Did you mean 'glide'"),
        ("no_such_module:f", None, "policy=no_such_module:f: No module named"),
        ("os:sep", None, "is a str; name a function"),
        (drivers.gentle, "human", "another name"),
        (3, None, "int is not a policy"),
    ],
)
def test_policies_that_cannot_be_used_are_refused(
    policy, name: str | None, message: str, easy: Context, evaluate: Evaluate
) -> None:
    with pytest.raises(IzooError, match=message):
        evaluate(policy, [easy], [0], name=name)
    with pytest.raises(IzooError, match="one or more"):
        evaluate("human", [easy], [])


def test_policies_that_change_lanes_meet_baselines_that_do_as_sumo_has_it(
    contexts: list[Context], evaluate: Evaluate
) -> None:
    changing = dataclasses.replace(SHORT, lane_change=True)
    tables = [evaluate(drivers.leftwards, contexts[:1], [11], config=config) for config in (changing, SHORT)]
    for name in ("human", "uncommanded"):
        one, other = (table[table["policy"] == name].reset_index(drop=True) for table in tables)
        assert_frame_equal(one[list(APPROACH_METRICS)], other[list(APPROACH_METRICS)])
