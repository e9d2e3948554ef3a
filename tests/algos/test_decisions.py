"""Decisions out of steps: what learners see where agents do not decide in every step."""

import contextlib
from collections import defaultdict
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from izoo.algos.actions.action_modes import SpeedAction
from izoo.algos.drivers.random import RandomDriver
from izoo.algos.learners.base import ACTION, DECIDES, DONE, LOG_PROB, MASK, NUMBER, OBSERVATION, REWARD, TERMINATED
from izoo.algos.learners.decisions import Decisions
from izoo.algos.learners.registry import make_algorithm, preset
from izoo.algos.learners.replay import transitions
from izoo.envs import EnvConfig, SumoParallelEnv, TwinEnv
from tests.envs.worlds import crossing

Decision = tuple[Any, ...]
CONFIG = EnvConfig(
    horizon_s=150.0, warmup_s=5.0, decide="vehicle_and_line", action="speed", num_agents=16, num_vehicles=64, emit=()
)


def make(simulator: str, config: EnvConfig = CONFIG) -> EnvBase:
    contexts = crossing(adoption=0.6)
    if simulator == "sumo":
        return SumoParallelEnv(2, contexts, config=config, shard=0)
    return TwinEnv(2, contexts, config=config, threads=1, surrogate="compiled", shard=0)


def collected(simulator: str, steps: int, config: EnvConfig = CONFIG) -> TensorDictBase:
    torch.manual_seed(5)
    with contextlib.closing(make(simulator, config)) as env:
        return env.rollout(steps, RandomDriver(config=config), break_when_any_done=False)


def one_by_one(batch: TensorDictBase) -> list[Decision]:
    """All decisions that ended in a batch, found by walking through its steps."""
    found: list[Decision] = []
    envs, length, slots = batch[MASK].shape
    for env in range(envs):
        for slot in range(slots):
            begun, paid = None, 0.0
            for step in range(length):
                if batch[DECIDES][env, step, slot] and batch[MASK][env, step, slot]:
                    begun, paid = step, 0.0
                if begun is None:
                    continue
                paid += float(batch["next"][REWARD][env, step, slot, 0])
                done = bool(batch["next"][DONE][env, step, slot, 0])
                if done or batch["next"][DECIDES][env, step, slot]:
                    found.append(
                        (
                            *(env, int(batch[NUMBER][env, begun, slot])),
                            *batch[OBSERVATION][env, begun, slot].tolist(),
                            *batch[ACTION][env, begun, slot].tolist(),
                            *batch["next"][OBSERVATION][env, step, slot].tolist(),
                            *(done, bool(batch["next"][TERMINATED][env, step, slot, 0]), round(paid, 4)),
                        )
                    )
                    begun = None
    return sorted(found)


def as_list(decisions: TensorDictBase) -> list[Decision]:
    """The same of decisions; environments are told apart by what they observe."""
    rows = []
    for frame in decisions.squeeze(1).unbind(0):
        (slot,) = (frame[MASK] & frame[DECIDES]).nonzero().view(-1).tolist()
        own, after = frame["agents"][slot], frame["next", "agents"][slot]
        rows.append(
            (
                int(own["number"]),
                *own["observation"].tolist(),
                *own["action"].tolist(),
                *after["observation"].tolist(),
                *(bool(after["done"]), bool(after["terminated"]), round(float(after["reward"]), 4)),
            )
        )
    return sorted(rows)


@pytest.mark.parametrize(
    ("simulator", "whole"), [("twin", False), ("twin", True), pytest.param("sumo", False, marks=pytest.mark.slow)]
)
def test_decisions_are_those_that_walking_through_the_steps_finds(simulator: str, whole: bool) -> None:
    batch = collected(simulator, 120)
    expected = sorted(decision[1:] for decision in one_by_one(batch))
    taken = Decisions(whole)
    parts = [taken(batch[:, begin : begin + 7]) for begin in range(0, batch.shape[1], 7)]
    found = sorted(row for part in parts for row in as_list(part))
    assert len(found) == len(expected) > 60
    torch.testing.assert_close(torch.tensor(found), torch.tensor(expected), rtol=1e-4, atol=1e-3)
    terminated = [row[-2] for row in found]
    assert 10 < sum(terminated) < len(terminated), "some left, some decided again or ran out of time"
    assert taken.open is not None
    begun = int((batch[MASK] & batch[DECIDES]).sum())
    assert begun == len(found) + len(taken.open)


def test_rewards_of_decisions_add_up_to_what_vehicles_are_paid() -> None:
    batch = collected("twin", 120)
    paid: dict[tuple[int, int, int], float] = defaultdict(float)
    episode = torch.cat([torch.zeros(2, 1, 1), batch["next", "done"].float().cumsum(1)[:, :-1]], 1)
    for env, step, slot in batch[MASK].nonzero().tolist():
        key = env, int(episode[env, step]), int(batch[NUMBER][env, step, slot])
        paid[key] += float(batch["next"][REWARD][env, step, slot, 0])
    decided = Decisions()(batch)
    whole = {key for key in paid if key[1] == 0}
    assert int(episode.max()) >= 1 and whole
    total = sum(value for value in paid.values())
    still_open = Decisions()
    still_open(batch)
    assert still_open.open is not None
    rest = float(still_open.open["reward_sum"].sum())
    assert float(decided["next"][REWARD].sum()) + rest == pytest.approx(total, rel=1e-4)


def test_what_has_not_ended_goes_on_from_a_saved_state() -> None:
    batch = collected("twin", 60)
    for whole in (False, True):
        straight, saved = Decisions(whole), Decisions(whole)
        straight(batch[:, :25])
        saved(batch[:, :25])
        again = Decisions(whole)
        again.load_state_dict(saved.state_dict())
        first, second = straight(batch[:, 25:]), again(batch[:, 25:])
        assert len(first) > 10 and as_list(first) == as_list(second)
    again.load_state_dict({})
    assert again.open is None


def test_stock_collectors_hand_over_decisions() -> None:
    with contextlib.closing(make("twin")) as env:
        collector = Collector(
            env, RandomDriver(config=CONFIG), frames_per_batch=60, total_frames=180, postproc=Decisions()
        )
        batches = list(collector)
    assert len(batches) == 3
    assert all(batch.shape[1:] == (1,) and batch["agents"].shape[1:] == (1, 1) for batch in batches)
    assert all(batch[DECIDES].all() for batch in batches) and sum(map(len, batches)) > 60


@pytest.mark.parametrize("name", ["ppo", "mappo", "gcrl"])
@pytest.mark.parametrize("parts", [("speed",), ("speed_before", "speed_behind")])
def test_learning_sees_the_policy_that_collected(name: str, parts: tuple[str, ...]) -> None:
    """The ratio of the first minibatch is 1, for networks that look at the other vehicles, too; only deciders count."""
    config = EnvConfig(**(vars(CONFIG) | {"action_parts": parts}))
    torch.manual_seed(0)
    algorithm: Any = make_algorithm(preset(name), SpeedAction(), config)
    with contextlib.closing(make("twin", config)) as env, torch.no_grad():
        batch = env.rollout(60, algorithm.policy, break_when_any_done=False)
    decisions = Decisions(getattr(algorithm, "looks_around", False))(batch)
    assert batch[ACTION].shape[-1] == len(parts)
    rows = algorithm.advantages(decisions)
    assert len(rows) == len(decisions)
    losses = algorithm.loss(rows)
    assert float(losses["max_ratio"]) == pytest.approx(1.0, abs=1e-4)
    assert float(losses["kl_approx"]) == pytest.approx(0.0, abs=1e-5)
    direct = algorithm.loss(decisions)  # as a stand-alone loss, on frames
    assert float(direct["mean_ratio"]) == pytest.approx(1.0, abs=1e-4)
    stats = algorithm.update(decisions, 0.0)
    assert all(map(torch.isfinite, map(torch.tensor, stats.values())))


def test_who_does_not_decide_weighs_nothing() -> None:
    """Others in a frame may be paid anything, and may have done anything."""
    torch.manual_seed(0)
    algorithm: Any = make_algorithm(preset("mappo"), SpeedAction(), CONFIG)
    with contextlib.closing(make("twin")) as env, torch.no_grad():
        batch = env.rollout(60, algorithm.policy, break_when_any_done=False)
    decisions = Decisions(whole=True)(batch)
    changed = decisions.clone()
    others = changed[MASK] & ~changed[DECIDES]
    assert others.any()
    changed["next"][REWARD][others] = 1e6
    changed[ACTION][others], changed[LOG_PROB][others] = 0.3, -9.0
    first, second = (algorithm.loss(part) for part in (decisions, changed))
    for key in list(first.keys()):
        torch.testing.assert_close(first[key], second[key])


def test_replays_hold_decisions() -> None:
    decisions = Decisions()(collected("twin", 60))
    rows = transitions(decisions, n_step=20)
    assert len(rows) == len(decisions)
    torch.testing.assert_close(rows["next"][REWARD].flatten(), decisions["next"][REWARD].flatten())
    whole = Decisions(whole=True)(collected("twin", 60))
    torch.testing.assert_close(transitions(whole)["next"][REWARD], rows["next"][REWARD])
