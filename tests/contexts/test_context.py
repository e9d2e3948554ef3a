"""A context as a TensorDict."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from izoo.contexts import catalogue
from izoo.contexts.procedural import procedural_context
from izoo.contexts.source import as_schedule
from izoo.envs.config import EnvConfig
from izoo.envs.specs import context_spec, observation_spec
from izoo.errors import IzooError


def test_to_tensordict_holds_the_observed_features_of_the_episode():
    context = catalogue.get(1_000_001)
    td = context.to_tensordict()
    assert td.batch_size == torch.Size([])
    assert float(td["adoption"]) == pytest.approx(context.adoption)
    assert float(td["temperature_c"]) == pytest.approx(context.temperature_c)
    assert float(td["humidity_pct"]) == pytest.approx(context.humidity_pct)
    assert float(td["engine"]) == ("combustion", "electric").index(context.engine)
    assert int(td["context_id"]) == 1_000_001
    assert int(procedural_context().to_tensordict()["context_id"]) == -1


def test_its_keys_and_shapes_are_those_of_an_environment():
    td = procedural_context().to_tensordict()
    spec = context_spec(torch.Size([]))
    for name, value in td.items():
        assert spec[name].is_in(value), name
    assert "context" in observation_spec(EnvConfig(), torch.Size([]))


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
