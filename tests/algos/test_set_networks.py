"""What MAPPO and graph RL share: whole frames, and indifference to slot order, slot count and padding."""

import copy
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType

from izoo.algos.learners import base
from izoo.algos.learners.graph_ppo import GCRL, GCRLConfig
from izoo.algos.learners.mappo import MAPPO, MAPPOConfig
from izoo.algos.learners.set_ppo import SetPPO
from izoo.algos.networks.set_networks import FRAME, places
from tests.algos.frames import FEATURES, SPACE, act, alone, make_frames, shake

KINDS = {
    "mappo": (MAPPO, MAPPOConfig, {"critic_queries": 2, "critic_embedding": 6}),
    "gcrl": (GCRL, GCRLConfig, {"neighbours": 1, "range_m": 400.0, "heads": 2}),
}
pytestmark = pytest.mark.parametrize("kind", KINDS)


def make(kind: str, **changes: object) -> SetPPO:
    algorithm, config, small = KINDS[kind]
    torch.manual_seed(3)
    made = algorithm(config(**{"hidden": (8, 8), "minibatch_rows": 7, **small, **changes}), FEATURES, SPACE)  # type: ignore[operator]
    shake(made.actor, 0.1)  # an untrained policy hardly looks at what it observes
    return made


def test_places_number_frames_and_agents(kind: str) -> None:
    mask = torch.tensor([[[1, 0, 1], [0, 0, 0]], [[0, 1, 0], [1, 1, 1]]], dtype=torch.bool)
    frame, column = places(mask)
    assert frame.tolist() == [0, 0, 1, 2, 2, 2]
    assert column.tolist() == [0, 1, 0, 0, 1, 2]


def test_values_are_those_of_each_frame_alone(kind: str) -> None:
    algorithm, batch = make(kind), make_frames()
    mask = batch[base.MASK]
    expected = alone(algorithm, batch[base.OBSERVATION], mask)
    with torch.no_grad():
        torch.testing.assert_close(algorithm.loss.value_estimator.values(batch, mask).squeeze(-1), expected[mask])
        some = mask & (torch.arange(4) == 2)
        torch.testing.assert_close(algorithm.loss.value_estimator.values(batch, some).squeeze(-1), expected[some])


def test_minibatches_are_whole_frames_and_cover_everything(kind: str) -> None:
    algorithm = make(kind, epochs=3, minibatch_rows=7, rows_per_epoch=None)
    rows = algorithm.advantages(act(algorithm, make_frames()))
    rows["row"] = torch.arange(len(rows))
    frame = rows[FRAME].clone()
    parts = list(algorithm._minibatches(rows))
    seen = torch.cat([part["row"] for part in parts])
    assert sorted(seen.tolist()) == sorted(3 * list(range(len(rows))))
    for part in parts:
        assert part[FRAME].unique().tolist() == list(range(int(part[FRAME].max()) + 1)), "numbered anew from 0"
        for number in part[FRAME].unique():
            members = part["row"][part[FRAME] == number]
            whole = (frame == frame[members[0]]).nonzero()[:, 0]
            assert sorted(members.tolist()) == whole.tolist()
    limited = make(kind, epochs=1, minibatch_rows=7, rows_per_epoch=6)
    assert sum(len(part) for part in limited._minibatches(rows)) == pytest.approx(6, abs=3)


@pytest.mark.parametrize("agents", [0, 1])
def test_few_agents(kind: str, agents: int) -> None:
    algorithm, batch = make(kind), make_frames()
    for group in (batch["agents"], batch["next", "agents"]):
        group["mask"] &= torch.arange(4) < agents
        for key in set(group.keys()) & {"done", "terminated", "truncated"}:
            group[key] &= (torch.arange(4) < agents).unsqueeze(-1)
    acted = act(algorithm, batch)
    assert acted[base.ACTION].isfinite().all()
    before = copy.deepcopy(algorithm.state_dict()["policy"])
    stats = algorithm.update(acted, 0.0)
    moved = any(not torch.equal(before[key], value) for key, value in algorithm.state_dict()["policy"].items())
    assert moved == bool(agents)
    assert all(math.isfinite(value) for value in stats.values())


def test_a_copied_policy_acts_by_its_own_weights(kind: str) -> None:
    algorithm, batch = make(kind), make_frames()
    mask, before = batch[base.MASK], act(algorithm, batch)[base.LOC]
    other = copy.deepcopy(algorithm.policy)
    with torch.no_grad():
        for parameter in algorithm.policy.parameters():
            parameter.zero_()
        assert torch.equal(other(batch.clone())[base.LOC], before)
    assert not act(algorithm, batch)[base.LOC][mask].any()


def test_noise_in_empty_slots_does_not_reach_actions(kind: str) -> None:
    algorithm, batch = make(kind), make_frames()
    noisy = batch.clone()
    noisy[base.OBSERVATION][~batch[base.MASK]] = 1e6
    mask = batch[base.MASK]
    torch.testing.assert_close(act(algorithm, noisy)[base.ACTION][mask], act(algorithm, batch)[base.ACTION][mask])
    assert act(algorithm, batch[0, 0])[base.ACTION].shape == (4, 1), "without a batch dimension, too"


def test_permuted_agents_act_alike(kind: str) -> None:
    algorithm, batch = make(kind), make_frames()
    order = torch.tensor([2, 0, 3, 1])
    permuted = TensorDict({"agents": batch["agents"][..., order]}, batch.batch_size)
    straight, turned = (act(algorithm, b, kind=ExplorationType.DETERMINISTIC)[base.ACTION] for b in (batch, permuted))
    mask = batch[base.MASK][..., order]
    torch.testing.assert_close(turned[mask], straight[..., order, :][mask])
