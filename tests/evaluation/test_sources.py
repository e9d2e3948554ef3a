"""What a results folder keeps so that its episodes can be played again."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from izoo.contexts import catalogue
from izoo.contexts.procedural import EASY
from izoo.errors import IzooError
from izoo.evaluation import evaluate_policy
from izoo.evaluation.sources import SOURCES_FILE, add_sources, context_from_dict, read_sources
from tests.evaluation.conftest import SHORT


def test_a_context_survives_json() -> None:
    for context in (EASY.sample(np.random.default_rng(0)), catalogue.get(7), catalogue.get(1_000_000)):
        again = context_from_dict(json.loads(json.dumps(dataclasses.asdict(context))))
        assert again == context
        assert again.content_hash == context.content_hash


def test_contexts_and_policies_add_up(tmp_path: Path) -> None:
    one, two = catalogue.get(0), catalogue.get(1)
    add_sources(tmp_path, [one], "glide", "glide")
    add_sources(tmp_path, [two, one], "ppo", tmp_path / "run" / "step-1.pt")
    sources = read_sources(tmp_path)
    assert sources.contexts == {one.content_hash: one, two.content_hash: two}
    assert sources.policies == {"glide": "glide", "ppo": "run/step-1.pt"}
    assert [path.name for path in tmp_path.iterdir()] == [SOURCES_FILE]


def test_a_policy_is_found_from_the_folder_that_a_link_leads_to(tmp_path: Path) -> None:
    (tmp_path / "disk" / "results").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "disk" / "results")
    add_sources(tmp_path / "link", [], "mine", tmp_path / "mine.pt")
    assert read_sources(tmp_path / "link").policies == {"mine": "../../mine.pt"}


def test_an_evaluation_writes_them(contexts, tmp_path: Path, cache: Path) -> None:
    evaluate_policy("tests.evaluation.odd_policies:gentle", contexts, [1], SHORT, 0, tmp_path, False, cache=cache)
    sources = read_sources(tmp_path)
    assert set(sources.contexts) == {context.content_hash for context in contexts}
    assert sources.policies == {"gentle": "tests.evaluation.odd_policies:gentle"}


def test_what_is_damaged_is_refused(tmp_path: Path) -> None:
    with pytest.raises(IzooError, match="has no sources"):
        read_sources(tmp_path)
    add_sources(tmp_path, [catalogue.get(0)], "glide", "glide")
    whole = (tmp_path / SOURCES_FILE).read_bytes()
    middle = len(whole) // 2
    for damaged in (b"half", whole[:middle], whole[:middle] + bytes(50) + whole[middle + 50 :]):
        (tmp_path / SOURCES_FILE).write_bytes(damaged)
        with pytest.raises(IzooError, match="is damaged"):
            read_sources(tmp_path)
