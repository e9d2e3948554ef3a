"""Notices where episodes come out otherwise than recorded, so that nobody forgets to raise ``MODEL_VERSION``.

After raising it, record: ``python -m tests.envs.test_model_version``.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import math
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import pytest
import torch
from tensordict import TensorDictBase

from izoo.contexts.context import Context
from izoo.contexts.procedural import procedural_context
from izoo.envs import MODEL_VERSION, EcoDrivingEnv, EnvConfig, RewardConfig
from izoo.envs.mdp.metric_sums import APPROACH_METRICS, EPISODE_METRICS
from izoo.errors import IzooError
from tests.envs.worlds import Driver, crossing, defer, set_action, steer_and_change

RECORD = Path(__file__).with_name("model_version.json")
HOW = "python -m tests.envs.test_model_version"
SEED = 5
RTOL, ATOL = 1e-6, 1e-4
Sums = dict[str, float]


class Case(NamedTuple):
    """An episode: what is played, by whom, and settings besides."""

    context: Context
    drive: str = "uncommanded"
    settings: Mapping[str, Any] = MappingProxyType({})


def lane(**changes: Any) -> Context:
    """One lane from one leg."""
    road = {"lane_count": 1, "approach": "A", "inflow_vph_per_lane": 500.0, "lane_length_m": 200.0, "adoption": 0.4}
    return procedural_context(**({"phase_count": 1, "offset_s": 2.0} | road | changes))


DRAINED = {"drain_s": 300.0}
FUEL = {"reward": RewardConfig.fuel()}
CASES: dict[str, Case] = {
    "one lane": Case(lane()),
    "one lane, glide, drained": Case(lane(), "glide", {**DRAINED, **FUEL}),
    "one lane, constant": Case(lane(), "constant", {"hold_s": 2.0}),
    "one lane, human, drained": Case(lane(adoption=0.0), "uncommanded", DRAINED),
    "two lanes": Case(crossing()),
    "two lanes, constant": Case(crossing(), "constant", {"reward": RewardConfig.fuel_team()}),
    "two lanes, glide": Case(crossing(), "glide", {"hold_s": 1.5, **FUEL}),
    "two lanes, drained": Case(crossing(engine="electric"), "uncommanded", DRAINED),
    "two lanes, changing": Case(crossing(), "changing", {"lane_change": True, "step_s": 1.0}),
    "three lanes": Case(crossing(lane_count=3, grade=0.03, cv_vehicle="human")),
    "three lanes, human": Case(crossing(lane_count=3, adoption=0.0)),
}
KEYS = [f"{simulator}, {name}" for simulator in ("twin", "sumo") for name in CASES]


def _driver(name: str, config: EnvConfig) -> Driver:
    if name == "uncommanded":
        return defer
    if name == "changing":
        return steer_and_change
    if name == "constant":
        return lambda state: set_action(state, torch.full((*state["agents", "mask"].shape, 1), 0.7))
    from izoo.algos.drivers.by_name import make_driver

    driver = make_driver(name, config)

    def rounded(state: TensorDictBase) -> TensorDictBase:
        # The last bits may differ from one kind of processor to another.
        return set_action(driver(state), state["agents", "action"].round(decimals=2))

    return rounded


def played(key: str) -> Sums:
    """Return all sums of an episode, those of approaches added up."""
    simulator, name = key.split(", ", 1)
    case = CASES[name]
    config = EnvConfig(**{"horizon_s": 140.0, "warmup_s": 20.0, "emit": ("metrics",), **case.settings})
    act = _driver(case.drive, config)
    with contextlib.closing(EcoDrivingEnv(case.context, config=config, simulator=simulator)) as env:
        state = env.reset(context=case.context, seed=SEED)
        while not state["done"].item():
            state = env.step_lean(act(state))
    approach, episode = state["metrics", "approach"], state["metrics", "episode"]
    sums = {name: float(approach[name].double().sum()) for name in APPROACH_METRICS}
    return sums | {f"episode_{name}": float(episode[name]) for name in EPISODE_METRICS}


def differences(recorded: dict[str, Sums], found: dict[str, Sums]) -> list[str]:
    """Return what differs, a line per episode."""
    lines = []
    for key, sums in found.items():
        old = recorded.get(key, {})
        names = [name for name in {**old, **sums} if not _close(old.get(name), sums.get(name))]
        if names:
            lines.append(f"{key}: {', '.join(f'{name} {old.get(name)} -> {sums.get(name)}' for name in names[:4])}")
    return lines


def _close(one: float | None, other: float | None) -> bool:
    return one is not None and other is not None and math.isclose(one, other, rel_tol=RTOL, abs_tol=ATOL)


def check(record: dict[str, Any], version: int, found: dict[str, Sums]) -> None:
    """Raise :class:`IzooError` where episodes differ from the record, or the record is of another version."""
    if record["model_version"] != version:
        raise IzooError(f"MODEL_VERSION is {version}, the record that of {record['model_version']}: record with {HOW}")
    if lines := differences(record["episodes"], found):
        raise IzooError(
            f"episodes come out otherwise than recorded for MODEL_VERSION {version}. If that is meant, raise it in "
            f"envs/model_version.py, and record with {HOW}:\n" + "\n".join(lines)
        )


def test_episodes_come_out_as_recorded() -> None:
    record = json.loads(RECORD.read_text())
    assert set(record["episodes"]) == set(KEYS)
    check(record, MODEL_VERSION, {key: played(key) for key in KEYS})


def test_a_record_of_another_version_is_to_be_made_anew() -> None:
    record = json.loads(RECORD.read_text())
    with pytest.raises(IzooError, match=f"MODEL_VERSION is {MODEL_VERSION + 1}, the record .*: record with {HOW}"):
        check(record, MODEL_VERSION + 1, record["episodes"])


def test_a_millionth_is_noticed_and_so_is_a_sum_that_is_new() -> None:
    record = json.loads(RECORD.read_text())
    for changes in ({"cohort_region_co2_g": 1.000002}, {"crossed": 1.01}):
        found = {key: dict(sums) for key, sums in record["episodes"].items()}
        for name, factor in changes.items():
            found[KEYS[0]][name] *= factor
        with pytest.raises(IzooError, match=f"raise it in (?s:.*){KEYS[0]}: {next(iter(changes))} "):
            check(record, record["model_version"], found)
    with pytest.raises(IzooError, match=r"one lane: own None -> 0.0"):
        check(record, record["model_version"], {KEYS[0]: {**record["episodes"][KEYS[0]], "own": 0.0}})


IN_A_COPY = """
import importlib.util, sys
from pathlib import Path
class Copies:
    def find_spec(self, name, path=None, target=None):
        folder = Path({folder!r}, name)
        if folder.exists():
            init = folder / "__init__.py"
            return importlib.util.spec_from_file_location(name, init, submodule_search_locations=[str(folder)])
sys.meta_path.insert(0, Copies())
import json
from tests.envs.test_model_version import MODEL_VERSION, RECORD, check, played
check(json.loads(RECORD.read_text()), MODEL_VERSION, {{key: played(key) for key in {keys!r}}})
"""


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_a_changed_constant_of_car_following_is_noticed(tmp_path: Path) -> None:
    """In a copy of the package, compiled anew, whose number stays what it is; SUMO's episodes are what they were."""
    for name in ("izoo", "izoo.envs"):
        spec = importlib.util.find_spec(name)
        assert spec is not None and spec.origin is not None
        shutil.copytree(Path(spec.origin).parent, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "docs"))
    following = tmp_path / "izoo.envs" / "twin" / "following.py"
    text = following.read_text()
    constant = "SUB_STEP_S = 0.25"
    assert constant in text
    following.write_text(text.replace(constant, "SUB_STEP_S = 0.5"))
    program = IN_A_COPY.format(folder=str(tmp_path), keys=["sumo, one lane", "twin, one lane"])
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=1200)
    assert run.returncode != 0 and "raise it in envs/model_version.py" in run.stderr, run.stderr
    assert "twin, one lane: " in run.stderr and "sumo, one lane: " not in run.stderr


def main() -> None:
    """Record the episodes for the present number."""
    rounded = {key: {name: float(f"{value:.9g}") for name, value in played(key).items()} for key in KEYS}
    episodes = ",\n".join(f"{json.dumps(key)}: {json.dumps(sums)}" for key, sums in rounded.items())
    RECORD.write_text(f'{{"model_version": {MODEL_VERSION}, "episodes": {{\n{episodes}\n}}}}\n')


if __name__ == "__main__":
    main()
