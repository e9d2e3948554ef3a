"""What MAPPO and graph RL share: minibatches of whole frames, few agents, and copies of a policy."""

import copy
import math

import pytest
import torch

from izoo.algos.learners import base
from izoo.algos.learners.graph_ppo import GCRL, GCRLConfig
from izoo.algos.learners.mappo import MAPPO, MAPPOConfig
from izoo.algos.learners.set_ppo import SetPPO
from izoo.algos.networks.set_networks import FRAME
from tests.algos.frames import FEATURES, SPACE, act, make_frames, shake

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
