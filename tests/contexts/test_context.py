"""Contexts do without PyTorch, and what is no set of contexts is refused."""

from __future__ import annotations

import subprocess
import sys

import pytest

from izoo.contexts.procedural import procedural_context
from izoo.contexts.source import as_schedule
from izoo.errors import IzooError


def test_contexts_do_without_torch():
    code = "import sys, izoo.contexts.catalogue as c; c.get(5).content_hash; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("contexts", "kind"), [("salt_lake_city", "a str;"), (["atlanta"], "a list of str;"), (3, "an? int;")]
)
def test_what_is_no_context_is_refused_by_its_type(contexts: object, kind: str) -> None:
    with pytest.raises(IzooError, match=f"contexts is {kind}.*give a Context"):
        as_schedule(contexts, seed=0)  # type: ignore[arg-type]


def test_whole_numbers_are_the_same_context_as_their_floats() -> None:
    whole = procedural_context(green_s=26, adoption=1, lane_length_m=300)
    assert whole.content_hash == procedural_context(green_s=26.0, adoption=1.0, lane_length_m=300.0).content_hash
    assert isinstance(whole.adoption, float)
