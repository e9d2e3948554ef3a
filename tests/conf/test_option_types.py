"""Every option of every command with what its type cannot be: refused in one sentence, whoever reads the options."""

import copy
import functools
import json
import math
import operator
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from izoo.algos.actions.action_modes import AdviseAction, ResidualAction
from izoo.algos.learners import registry
from izoo.algos.learners.ppo import PPOConfig
from izoo.benchmarks.campaign.__main__ import CampaignConfig
from izoo.cli.option_command import compose_config
from izoo.conf.built_in import CatalogueContexts, CityContexts
from izoo.conf.context_choices import PcgContexts
from izoo.conf.evaluate_options import EvaluateConfig
from izoo.conf.train_options import CollectConfig, TrainConfig
from izoo.errors import IzooError
from izoo.options import from_mapping, to_mapping
from izoo.report.__main__ import ReportConfig

CONFIGS: dict[str, Any] = {
    **{f"train {name}": compose_config(TrainConfig, [f"algo={name}"]) for name in registry.choices()},
    "train residual": TrainConfig(action=ResidualAction()),
    "train advise": TrainConfig(action=AdviseAction()),
    "train pcg": TrainConfig(contexts=PcgContexts()),
    "evaluate": EvaluateConfig(),
    "evaluate catalogue": EvaluateConfig(contexts=CatalogueContexts(ids=(1,))),
    "collect": CollectConfig(contexts=CityContexts()),
    "report": ReportConfig(),
    "benchmarks.campaign": CampaignConfig(),
}
"""Options that between them hold every group."""
NOT_A_NUMBER = ("soon", [], {}, True, math.nan, math.inf, -math.inf)
WRONG: dict[type, tuple[Any, ...]] = {
    bool: ("soon", 2, [], {}, math.nan),
    int: (*NOT_A_NUMBER, 0.5, -(10**30), 10**30),
    float: NOT_A_NUMBER,
    str: ([], {}, True),
    list: (3, "soon", {}, math.nan, [{}], [[]]),
}
LISTS = {f"contexts.{name}" for name in ("city", "season", "hour", "engine", "adoption")}
"""Options that take one value or a list of them; of an empty one, no context is left, which building them says."""


def leaves(values: dict[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every option that has a value, by its path."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from leaves(value, (*path, name))
        elif value is not None:
            yield (*path, name), value


def changed(values: dict[str, Any], path: tuple[str, ...], value: Any) -> dict[str, Any]:
    """A copy with one option changed."""
    values = copy.deepcopy(values)
    place = values
    for name in path[:-1]:
        place = place[name]
    place[path[-1]] = value
    return values


@pytest.mark.parametrize("name", CONFIGS)
def test_every_option_refuses_what_its_type_cannot_be(name: str) -> None:
    values, cls = to_mapping(CONFIGS[name]), type(CONFIGS[name])
    taken, walked = [], 0
    for path, default in leaves(values):
        for wrong in WRONG[type(default)]:
            if wrong == [] and ".".join(path) in LISTS:
                continue
            walked += 1
            try:
                from_mapping(cls, changed(values, path, wrong))
                taken.append(f"{'.'.join(path)}={wrong!r}")
            except IzooError as error:
                assert str(error)
    assert taken == []
    assert walked > 10


def test_what_is_refused_is_named_with_what_it_must_be() -> None:
    wrong: list[tuple[Any, dict[str, Any], str]] = [
        (PPOConfig, {"frames_per_batch": "x"}, r"algo\.frames_per_batch is 'x'; it must be a whole number\."),
        (PPOConfig, {"value_loss": "l3"}, r"algo\.value_loss is 'l3'; it must be one of l2, smooth_l1\."),
        (PPOConfig, {"hidden": 128}, r"algo\.hidden is 128; it must be a list, each entry a whole number\."),
        (TrainConfig, {"num_workers": 0.5}, r"^num_workers is 0\.5; it must be a whole number\."),
    ]
    for config, options, message in wrong:
        with pytest.raises(IzooError, match=message):
            config(**options)


@pytest.mark.parametrize("name", CONFIGS)
def test_numbers_of_numpy_are_as_good_as_pythons(name: str) -> None:
    """They become Python's, so that options can be written down and compared."""
    values = to_mapping(CONFIGS[name])
    for path, value in leaves(values):
        if type(value) in (int, float):
            group = functools.reduce(operator.getitem, path[:-1], values)
            group[path[-1]] = {int: np.int64, float: np.float64}[type(value)](value)
    found = from_mapping(type(CONFIGS[name]), values)
    assert found == CONFIGS[name]
    json.dumps(to_mapping(found))
