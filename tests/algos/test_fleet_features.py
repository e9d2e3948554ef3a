"""MAPPO's critic over all vehicles: the picture by hand, what it changes, and a real run."""

import contextlib
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from izoo.algos.learners import base
from izoo.algos.learners.mappo import MAPPO, MAPPOConfig
from izoo.algos.networks.fleet_features import CHANNELS, COLUMNS, FLEET, FLEET_WIDTH, add_fleet, fleet_picture
from izoo.cli.option_command import compose_config
from izoo.conf.train_options import TrainConfig
from izoo.training.environments import training_class
from tests.algos.frames import FEATURES, SPACE, act, make_frames
from tests.envs.worlds import crossing, defer, short

CELLS = FLEET_WIDTH // CHANNELS
VEHICLES = [  # speed, position, approach, is_cv, present
    (0.5, -10.0, 0, True, True),
    (12.0, -10.0, 0, False, True),
    (6.0, -300.0, 1, False, True),
    (9.0, 20.0, 9, True, True),
    (float("nan"), -40.0, 2, True, False),
]


def vehicles(shape: tuple[int, ...] = ()) -> TensorDict:
    columns = zip(*VEHICLES, strict=True)
    kinds = (torch.float32, torch.float32, torch.int32, torch.bool, torch.bool)
    leaves = {name: torch.tensor(v, dtype=k) for name, v, k in zip(COLUMNS, columns, kinds, strict=True)}
    return TensorDict({name: leaf.expand(*shape, 5) for name, leaf in leaves.items()}, [*shape, 5])


def test_the_picture_by_hand() -> None:
    count, speed, standing, controlled = fleet_picture(vehicles()).view(CHANNELS, CELLS) * 5.0
    expected = torch.zeros(CHANNELS, CELLS)
    expected[:, 6] = torch.tensor([2.0, 12.5 / 15.0, 1.0, 1.0])  # approach 0, the last 15 m
    expected[:, 8] = torch.tensor([1.0, 6.0 / 15.0, 0.0, 0.0])  # approach 1, farther than 200 m
    expected[:, 5 * 8 + 7] = torch.tensor([1.0, 9.0 / 15.0, 0.0, 1.0])  # beyond the line; from one of many approaches
    torch.testing.assert_close(torch.stack([count, speed, standing, controlled]), expected)
    shuffled = vehicles()[torch.tensor([3, 1, 4, 0, 2])]
    torch.testing.assert_close(fleet_picture(shuffled), fleet_picture(vehicles()))


@pytest.mark.parametrize("credit", ["agent", "team"])
def test_the_critic_sees_human_drivers_and_the_policy_does_not(credit: str) -> None:
    torch.manual_seed(0)
    small = {"hidden": (6, 6), "critic_queries": 2, "critic_embedding": 4}
    mappo = MAPPO(MAPPOConfig(critic_sees="all", credit=credit, **small), FEATURES, SPACE)  # type: ignore[arg-type]
    batch = act(mappo, make_frames())
    for part in (batch, batch["next"]):
        part["vehicles"] = vehicles((2, 6)).clone()
    batch["next", "done"] = torch.zeros(2, 6, 1, dtype=torch.bool)
    batch["next", "terminated"] = torch.zeros(2, 6, 1, dtype=torch.bool)
    batch["next", "team_reward"] = torch.randn(2, 6, 1)
    other = batch.clone()
    other["vehicles", "speed_mps"][0, 2, 1] = 0.0  # a human driver stops
    found = []
    for played in (batch, other):
        seen = played.copy()
        add_fleet(seen)
        estimator, mask = mappo.loss.value_estimator, played[base.MASK]
        with torch.no_grad():
            if credit == "team":
                found.append(estimator.team_values(seen, torch.ones(2, 6, dtype=torch.bool)).squeeze(-1))
            else:
                found.append(torch.zeros(2, 6, 4).masked_scatter(mask, estimator.values(seen, mask)))
    changed = found[0] != found[1]
    assert changed[0, 2].any() and not changed[1].any() and not changed[0, [0, 1, 3, 4, 5]].any()
    assert FLEET not in mappo.policy.in_keys and ("vehicles", "speed_mps") not in mappo.policy.in_keys
    before = [parameter.clone() for parameter in mappo.critic.parameters()]
    assert math.isfinite(mappo.update(batch, 0.0)["loss_critic"])
    assert any(not torch.equal(one, two) for one, two in zip(before, mappo.critic.parameters(), strict=True))
    assert FLEET not in batch.keys(True), "the batch stays as it is"


def test_training_environments_emit_what_it_needs_and_no_more() -> None:
    config = compose_config(TrainConfig, ["algo=mappo", "algo.critic_sees=all"])
    assert config.env.emit == ("vehicles",)
    env = training_class("twin")(2, crossing(), config=short(emit=("vehicles",)), threads=1)
    with contextlib.closing(env):
        check_env_specs(env)
        state = env.reset()
        for _ in range(40):
            _, state = env.step_and_maybe_reset(defer(state))
        assert set(state["vehicles"].keys()) == set(COLUMNS)
        picture = fleet_picture(state["vehicles"]).view(2, CHANNELS, CELLS) * 5.0
        humans = state["vehicles", "present"] & ~state["vehicles", "is_cv"]
        torch.testing.assert_close((picture[:, 0] - picture[:, 3]).sum(-1), humans.sum(-1).float())
        assert humans.any()
