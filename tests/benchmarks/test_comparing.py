"""Folders of benchmarks: the settings they were begun with, what their stores lack, and side results."""

from __future__ import annotations

from pathlib import Path

import pytest

from izoo.benchmarks.campaign.comparing import check_settings
from izoo.contexts.procedural import procedural_context
from izoo.errors import IzooError
from izoo.results.rollout import Play, missing
from izoo.results.store import Store

CONTEXT = procedural_context()


def test_a_folder_takes_what_it_was_begun_with_or_more(tmp_path: Path) -> None:
    def check(**options: object) -> None:
        check_settings(tmp_path / "out", options, may_differ=("threads",), may_grow=("algos", "seeds", "eta"))

    check(algos=["ppo"], seeds=2, eta=[], horizon_s=100.0, threads=1)
    check(algos=["ppo", "glide"], seeds=4, eta=[], horizon_s=100.0, threads=2)
    with pytest.raises(
        IzooError, match=r"out holds results with other settings \(horizon_s 100.0 -> 101.0, seeds 4 -> 2\)"
    ):
        check(algos=["ppo", "glide"], seeds=2, eta=[], horizon_s=101.0)
    with pytest.raises(IzooError, match="algos"):
        check(algos=["glide"], seeds=4, eta=[], horizon_s=100.0)
    with pytest.raises(IzooError, match="eta"):  # points of a weight that was not swept over have other names
        check(algos=["ppo", "glide"], seeds=4, eta=[0.5], horizon_s=100.0)


@pytest.mark.parametrize("content", ["seeds: [2", "- 1\n- 2\n"])
def test_a_folder_that_cannot_be_read_is_one_sentence(content: str, tmp_path: Path) -> None:
    (tmp_path / "settings.yaml").write_text(content)
    with pytest.raises(IzooError, match=r"cannot read .*settings\.yaml.*choose another out"):
        check_settings(tmp_path, {"seeds": 2})


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(IzooError, match=r"not empty and has no settings\.yaml"):
        check_settings(tmp_path, {})


def test_what_a_store_lacks() -> None:
    store = Store(None)
    plays = [Play("ppo", seed, CONTEXT, 7) for seed in (0, 1)]
    store.done.add(("ppo", 0, "twin", CONTEXT.content_hash, 7))
    assert missing(store, plays, "twin") == plays[1:] and missing(store, plays, "sumo") == plays
