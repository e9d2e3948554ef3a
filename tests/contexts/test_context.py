"""Which contexts are the same, and what is no set of contexts is refused."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from izoo.contexts.procedural import procedural_context
from izoo.contexts.source import as_schedule
from izoo.errors import IzooError
from izoo.results.store import PolicyRecord, Store


@pytest.mark.parametrize(
    ("contexts", "kind"), [("salt_lake_city", "a str;"), (["atlanta"], "a list of str;"), (3, "an? int;")]
)
def test_what_is_no_context_is_refused_by_its_type(contexts: object, kind: str) -> None:
    with pytest.raises(IzooError, match=f"contexts is {kind}.*give a Context"):
        as_schedule(contexts, seed=0)  # type: ignore[arg-type]


def test_whole_numbers_and_those_of_numpy_are_the_same_context_as_floats() -> None:
    given = procedural_context(green_s=26.0, adoption=1.0, lane_length_m=300.0)
    for number in (int, np.int64, np.float32):
        same = procedural_context(green_s=number(26), adoption=number(1), lane_length_m=number(300))
        assert same.content_hash == given.content_hash and isinstance(same.adoption, float)


@pytest.mark.parametrize("name", ["", "a\rb", "a\nb", "a\0b", "a\udc80b", "a\u2028b", "a\x1b[2Jb"])
def test_names_that_no_table_can_hold_are_refused(name: str, tmp_path: Path) -> None:
    """Of intersections, policies and tasks."""
    with pytest.raises(IzooError, match=r"the name of an intersection is .*one line of text"):
        dataclasses.replace(procedural_context().intersection, name=name)
    store = Store(tmp_path / "out")
    with pytest.raises(IzooError, match="the name of a policy is"), store.open({name: PolicyRecord()}):
        pass
    if name:
        with pytest.raises(IzooError, match="the name of a task is"):
            Store(tmp_path / "out", task=name)
