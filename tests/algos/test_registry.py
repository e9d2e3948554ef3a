"""Algorithms by name: what the registry offers can be chosen and built."""

import dataclasses

import pytest

from izoo.algos.learners.registry import choices, make_algorithm, preset
from izoo.cli.option_command import compose_config
from izoo.conf.train_options import TrainConfig
from izoo.errors import IzooError
from izoo.options import from_mapping


@pytest.mark.parametrize("choice", choices())
def test_every_choice_composes_and_builds(choice: str) -> None:
    config = compose_config(TrainConfig, [f"algo={choice}"])
    assert config.algo == preset(choice)
    small = {"hidden": (8,)} if hasattr(config.algo, "hidden") else {}
    algo = dataclasses.replace(config.algo, **small)  # type: ignore[arg-type]
    assert make_algorithm(algo, config.action, config.env).policy is not None


def test_unknown_names_are_refused_by_the_legal_ones() -> None:
    with pytest.raises(IzooError, match="Did you mean 'ppo'"):
        preset("pppo")
    with pytest.raises(IzooError, match="unknown algo 'sarsa'"):
        from_mapping(TrainConfig, {"algo": {"name": "sarsa"}})
    with pytest.raises(IzooError, match="group of options"):
        from_mapping(TrainConfig, {"algo": "ppo"})
