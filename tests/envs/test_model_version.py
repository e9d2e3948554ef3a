"""Fails if recorded episodes change and ``MODEL_VERSION`` was not raised.

After raising it, record: ``python -m tests.envs.test_model_version``.
"""

import contextlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from tensordict import TensorDictBase

from izoo.contexts.context import Context
from izoo.envs import MODEL_VERSION, EcoDrivingEnv, EnvConfig, RewardConfig
from izoo.envs.mdp.metric_sums import APPROACH_METRICS, EPISODE_METRICS
from tests.envs.worlds import Driver, constant, crossing, defer, one_lane, set_action, steer_and_change

RECORD = Path(__file__).with_name("model_version.json")
HOW = "python -m tests.envs.test_model_version"
SEED = 5
RTOL, ATOL = 1e-6, 1e-4
Sums = dict[str, float]


class Case(NamedTuple):
    """An episode: context, driver, and settings."""

    context: Context
    drive: str = "uncommanded"
    settings: Mapping[str, Any] = MappingProxyType({})


def lane(**changes: Any) -> Context:
    return one_lane(**({"lane_length_m": 200.0, "adoption": 0.4} | changes))


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
        return constant(0.7)
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
    for key in sorted({*recorded, *found}):
        old, new = recorded.get(key, {}), found.get(key, {})
        names = [name for name in {**old, **new} if not _close(old.get(name), new.get(name))]
        if names:
            lines.append(f"{key}: {', '.join(f'{name} {old.get(name)} -> {new.get(name)}' for name in names[:4])}")
    return lines


def _close(one: float | None, other: float | None) -> bool:
    return one is not None and other is not None and math.isclose(one, other, rel_tol=RTOL, abs_tol=ATOL)


def test_episodes_equal_the_record() -> None:
    record = json.loads(RECORD.read_text())
    assert record["model_version"] == MODEL_VERSION, f"the record is of another version: record with {HOW}"
    lines = differences(record["episodes"], {key: played(key) for key in KEYS})
    assert not lines, "\n".join([f"if intended, raise it in envs/model_version.py, and record with {HOW}:", *lines])


def test_a_change_of_a_millionth_and_a_new_sum_are_found() -> None:
    recorded = json.loads(RECORD.read_text())["episodes"]
    sums = recorded[KEYS[0]]
    for name, value in (("cohort_region_co2_g", 1.000002 * sums["cohort_region_co2_g"]), ("own", 0.0)):
        (line,) = differences(recorded, {**recorded, KEYS[0]: {**sums, name: value}})
        assert line.startswith(f"{KEYS[0]}: {name} {sums.get(name)} -> ")


def main() -> None:
    """Record the episodes for the present number."""
    rounded = {key: {name: float(f"{value:.9g}") for name, value in played(key).items()} for key in KEYS}
    episodes = ",\n".join(f"{json.dumps(key)}: {json.dumps(sums)}" for key, sums in rounded.items())
    RECORD.write_text(f'{{"model_version": {MODEL_VERSION}, "episodes": {{\n{episodes}\n}}}}\n')


if __name__ == "__main__":
    main()
