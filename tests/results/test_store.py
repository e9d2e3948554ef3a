"""Results folders: rows are appended whole, finished ones are kept, and what does not fit is one sentence."""

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path

import pandas as pd
import pytest
from pandas.testing import assert_frame_equal

from izoo.envs.config import EnvConfig
from izoo.errors import IzooError
from izoo.results.schema import EPISODE, Row
from izoo.results.store import Key, PolicyRecord, Store, own_settings, read_manifest, read_table
from tests.conftest import SHORT

A, B = PolicyRecord("trained", "a" * 64), PolicyRecord("trained", "b" * 64)


def episodes(table: pd.DataFrame, policy: str = "policy") -> list[list[Row]]:
    rows = table[table["policy"] == policy]
    return [part.to_dict("records") for _, part in rows.groupby(list(EPISODE))]


def kept(path: Path, policies: Mapping[Key, PolicyRecord], new: list[list[Row]], config: EnvConfig = SHORT) -> int:
    """Open a folder, add episodes, and return how many were there."""
    store = Store(path, config=config)
    with store.open(policies):
        before = len(store.done)
        for rows in new:
            store.add(rows)
    return before


def test_rows_read_back_exactly(table: pd.DataFrame, tmp_path: Path) -> None:
    """Also names that mean nothing elsewhere, and infinity."""
    rows = table.to_dict("records")
    rows[0] |= {"policy": "null", "intersection": "NA", "volume_over_capacity": math.inf, "seed": 2**62 + 1}
    store = Store(tmp_path, task="a test", config=SHORT)
    with store.open():
        for row in rows:
            store.add([row])
    assert_frame_equal(read_table(tmp_path), store.table, check_exact=True)
    manifest = read_manifest(tmp_path)
    assert manifest.complete and manifest.task == "a test"
    assert manifest.config("null") == dataclasses.replace(SHORT, emit=EnvConfig().emit)


def test_an_interrupted_folder_goes_on(table: pd.DataFrame, tmp_path: Path) -> None:
    one, two, *_ = episodes(table)
    store = Store(tmp_path, config=SHORT)
    with pytest.raises(KeyboardInterrupt), store.open({"policy": A}):
        store.add(one)
        raise KeyboardInterrupt
    assert not read_manifest(tmp_path).complete and len(read_table(tmp_path)) == len(one)
    assert kept(tmp_path, {"policy": A}, [two]) == 1
    assert read_manifest(tmp_path).complete and len(read_table(tmp_path)) == 2


def test_other_weights_replace_the_rows_of_their_policy_and_seed_only(table: pd.DataFrame, tmp_path: Path) -> None:
    one, two, *_ = episodes(table)
    seeds: dict[Key, PolicyRecord] = {("policy", 0): A, ("policy", 1): A}
    human = episodes(table, "human")[0]
    kept(tmp_path, {**seeds, "human": PolicyRecord(source="human")}, [one, [{**two[0], "train_seed": 1}], human])
    assert kept(tmp_path, seeds, []) == 3
    assert kept(tmp_path, {("policy", 1): B}, []) == 2
    assert kept(tmp_path, {("policy", 1): A}, []) == 2, "the first weights' rows came back as those of the second"
    assert set(read_table(tmp_path)["policy"]) == {"policy", "human"}
    assert read_manifest(tmp_path).policies["policy"] == {0: A, 1: A}


def test_policies_with_settings_of_their_own_share_a_folder(table: pd.DataFrame, tmp_path: Path) -> None:
    slow = dataclasses.replace(SHORT, hold_s=2.0)
    own = [dataclasses.replace(A, env=own_settings(config)) for config in (SHORT, slow)]
    kept(tmp_path, {"fast": own[0], "slow": own[1]}, [])
    assert read_manifest(tmp_path).config("slow").hold_s == 2.0
    with pytest.raises(IzooError, match=r"holds fast with other settings \(hold_s None -> 2\.0\)"):
        kept(tmp_path, {"fast": own[1]}, [])


def test_other_settings_and_versions_are_refused_by_name(table: pd.DataFrame, tmp_path: Path) -> None:
    kept(tmp_path, {}, episodes(table)[:1])
    before = (tmp_path / "rows.csv").read_bytes()
    with pytest.raises(IzooError, match=r"other settings \(step_s 0\.5 -> 1\.0\); choose another folder"):
        kept(tmp_path, {}, [], dataclasses.replace(SHORT, step_s=1.0))
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    (tmp_path / "manifest.json").write_text(json.dumps({**manifest, "model_version": -1}))
    with pytest.raises(IzooError, match=r"\(model_version -1 -> \d+\)"):
        kept(tmp_path, {}, [])
    assert (tmp_path / "rows.csv").read_bytes() == before


def test_what_is_no_results_folder_is_one_sentence(table: pd.DataFrame, tmp_path: Path) -> None:
    with pytest.raises(IzooError, match="no such results folder"):
        read_table(tmp_path / "nope")
    with pytest.raises(IzooError, match=r"is not a results folder: it has no manifest\.json"):
        read_table(tmp_path)
    new = tmp_path / "new"
    kept(new, {}, [])
    with pytest.raises(IzooError, match="has no episodes yet"):
        read_table(new)
    kept(new, {}, episodes(table)[:1])
    old = pd.read_csv(new / "rows.csv").drop(columns=["cohort", "crossed"])
    old.to_csv(new / "rows.csv", index=False)
    with pytest.raises(IzooError, match=r"lacks the column\(s\) crossed, cohort: another version of izoo wrote it"):
        read_table(new)
    (new / "manifest.json").write_text('{"format": "izoo-results-0"}')
    with pytest.raises(IzooError, match="is of another version of izoo"):
        read_table(new)
