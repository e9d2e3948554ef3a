"""The search over glide's settings: its start, the two kinds of roads, who tells whom, and what is refused."""

import dataclasses
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo.algos.actions.action_modes import AdviseAction, DirectAction
from izoo.algos.drivers.base import DEFER
from izoo.algos.drivers.glide import Glide, GlideConfig
from izoo.algos.learners import base
from izoo.algos.learners.glide_search import GATE, GATE_STARTS, OTHERS, SETTINGS, GlideSearch, GlideSearchConfig
from izoo.algos.learners.registry import make_algorithm
from izoo.algos.losses.masked_gae import TEAM_REWARD
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.errors import IzooError
from izoo.results.policies import weights_hash

ENV = EnvConfig(hold_s=2.0, observed=("adoption", "green_s", "red_s", "lane_count", "lane_length_m", "speed_limit_mps"))
NAMES = observation_names(ENV)
LANES, AGENTS, STEPS = NAMES.index("context_lane_count"), 7, 3
ONE, SEVERAL = 1 / 4, 3 / 4


def make(population: int = 4, seed: int = 0) -> GlideSearch:
    torch.manual_seed(seed)
    made: Any = make_algorithm(GlideSearchConfig(population=population), DirectAction(), ENV)
    return made


def seen(envs: int, lanes: float, seed: int = 3, adoption: float = 1 / 3, length_m: float = 250.0) -> TensorDict:
    """CVs on their way to a red light that lasts for 20 to 50 s more, the same in each environment."""
    generator = torch.Generator().manual_seed(seed)
    rows = torch.zeros(envs, AGENTS, len(NAMES))
    values = {
        "speed": torch.rand(AGENTS, generator=generator) * 0.5 + 0.5,
        "stop_line_distance": -torch.rand(AGENTS, generator=generator) - 0.3,
        "signal_time_left": torch.rand(AGENTS, generator=generator) * 0.3 + 0.2,
        "leader_distance": torch.rand(AGENTS, generator=generator) * 3,
    }
    fixed = {"location_approaching": 1.0, "signal_red": 1.0, "follower_distance": 0.1, "context_speed_limit_mps": 1.0}
    fixed |= {"signal_second_green": 1.4, "signal_third_green": 2.4, "context_green_s": 0.4, "context_red_s": 0.6}
    fixed |= {"context_adoption": adoption, "context_lane_length_m": length_m / 250.0}
    for name, value in {**fixed, "leader_present": 1.0, "context_lane_count": lanes}.items():
        rows[..., NAMES.index(name)] = value
    for name, column in values.items():
        rows[..., NAMES.index(name)] = column
    mask = torch.ones(envs, AGENTS, dtype=torch.bool)
    mask[:, -1] = False
    return TensorDict({"agents": {"observation": rows, "mask": mask}}, [envs])


def act(algorithm: GlideSearch, frame: TensorDict, kind: ExplorationType = ExplorationType.DETERMINISTIC) -> TensorDict:
    with set_exploration_type(kind):
        return algorithm.policy(frame.clone())


def generation(algorithm: GlideSearch, lanes: float, goal: int = 0) -> TensorDict:
    """Whole episodes on roads of so many lanes; paid is who has a large number ``goal``."""
    population = len(algorithm.policy.candidates)
    own = algorithm.policy.candidates[:, int(lanes > ONE), goal].float()
    reward = (own - 10.0)[:, None, None].expand(population, STEPS, 1) / STEPS
    done = torch.zeros(population, STEPS, 1, dtype=torch.bool)
    done[:, -1] = True
    frames = torch.stack([act(algorithm, seen(population, lanes))] * STEPS, dim=1)
    return frames.set("next", TensorDict({TEAM_REWARD: reward, "done": done}, [population, STEPS]))


def test_acting_leaves_the_policy_as_it_is() -> None:
    """The hash of its weights says whether results are of this policy."""
    algorithm = make()
    before = weights_hash(algorithm.policy.eval())
    act(algorithm, seen(2, SEVERAL))
    assert before is not None and weights_hash(algorithm.policy) == before


@pytest.mark.parametrize("lanes", [ONE, SEVERAL])
def test_at_its_start_it_drives_as_glide_with_those_settings(lanes: float) -> None:
    kind = int(lanes > ONE)
    start = {setting.name: setting.starts[kind] for setting in SETTINGS} | OTHERS
    glide = Glide(ENV, GlideConfig(**start, max_lanes=9, min_green_share=0.0))
    frame = seen(2, lanes, adoption=0.1)  # where CVs are few the gate is open
    acted, wanted = act(make(), frame), glide(frame.clone())
    assert (~wanted[DEFER]).any() and wanted[DEFER].any()
    mask = frame[base.MASK]
    assert torch.equal(acted[DEFER][mask], wanted[DEFER][mask])
    drives = mask & ~wanted[DEFER]
    torch.testing.assert_close(acted[base.ACTION][drives], wanted[base.ACTION][drives])
    assert acted[DEFER][~mask].all() and not acted[base.ACTION][~mask].any()


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda setting: setting.name)
def test_every_setting_that_is_searched_is_one_of_glide(setting: Any) -> None:
    assert setting.name in {field.name for field in dataclasses.fields(GlideConfig)}
    for several, start in zip((False, True), setting.starts, strict=True):
        assert float(setting.value(torch.zeros(()), torch.tensor(several))) == pytest.approx(start)
        assert float(setting.value(torch.ones(()), torch.tensor(several))) > start


def test_where_the_gate_is_closed_cvs_brake_gently_for_stops_that_are_certain() -> None:
    """By red as with glide; also by a green that ends before they are there, and behind a leader that is near."""
    algorithm = make()
    algorithm.policy.mean[:, len(SETTINGS)] = -20.0
    frame = seen(1, SEVERAL)
    rows = frame[base.OBSERVATION]
    values = {"speed": 0.9, "stop_line_distance": -0.6, "leader_distance": 0.04, "leader_speed": 0.9}
    for name, value in {**values, "signal_time_left": 0.5}.items():
        rows[..., NAMES.index(name)] = value  # 150 m before the line, 10 m behind a leader, red for 50 s
    assert not act(algorithm, frame)[DEFER][0, :-1].any()
    assert (act(algorithm, frame)[base.ACTION][0, :-1] < 0.0).all()
    rows[..., NAMES.index("signal_red")] = 0.0
    rows[..., NAMES.index("signal_green")] = 1.0
    assert act(algorithm, frame)[DEFER].all()  # green for 50 s
    rows[..., NAMES.index("signal_time_left")] = 0.05
    assert not act(algorithm, frame)[DEFER][0, :-1].any()  # for 5 s
    rows[..., NAMES.index("stop_line_distance")] = -0.2
    rows[..., NAMES.index("signal_time_left")] = 0.04
    assert act(algorithm, frame)[DEFER].all()  # 50 m are 4 s


def test_each_kind_of_road_has_numbers_of_its_own() -> None:
    algorithm = make()
    before = {lanes: act(algorithm, seen(1, lanes))[DEFER] for lanes in (ONE, SEVERAL)}
    algorithm.policy.mean[1, len(SETTINGS)] = -20.0  # the gate is never open on several lanes
    algorithm.policy.mean[1, [setting.name for setting in SETTINGS].index("stop_decel_mps2")] = 6.0
    assert torch.equal(act(algorithm, seen(1, ONE))[DEFER], before[ONE])
    assert not before[SEVERAL].all()
    assert act(algorithm, seen(1, SEVERAL))[DEFER].all()


def test_contexts_tell_the_search_of_their_kind_alone() -> None:
    algorithm = make()
    before = algorithm.policy.candidates.clone()
    stats = algorithm.update(generation(algorithm, ONE), 0.0)
    assert stats["return_spread"] > 0.0
    assert torch.equal(algorithm.policy.candidates[:, 1], before[:, 1])
    assert not torch.equal(algorithm.policy.candidates[:, 0], before[:, 0])


def test_it_finds_what_is_paid_and_goes_on_exactly_where_it_stopped() -> None:
    one, other = make(population=8), make(population=8, seed=1)
    for number in range(20):
        one.update(generation(one, (ONE, SEVERAL)[number % 2]), 0.0)
    assert (one.policy.mean[:, 0] > 2.0).all()
    other.load_state_dict(one.state_dict())
    assert torch.equal(one.policy.candidates, other.policy.candidates)
    one.update(generation(one, SEVERAL), 0.0)
    other.update(generation(other, SEVERAL), 0.0)
    assert torch.equal(one.policy.candidates, other.policy.candidates)


def test_blocks_of_environments_belong_to_one_rule_each() -> None:
    algorithm = make()
    explored = act(algorithm, seen(8, ONE), ExplorationType.RANDOM)
    for number in range(4):
        algorithm.policy.mean.copy_(algorithm.policy.candidates[number])
        alone = act(algorithm, seen(2, ONE))
        assert torch.equal(explored[base.ACTION][2 * number : 2 * number + 2], alone[base.ACTION])
    assert len(explored[base.ACTION][::2].flatten(1).unique(dim=0)) > 1


def test_what_does_not_suit_it_is_refused() -> None:
    with pytest.raises(IzooError, match="action=direct"):
        make_algorithm(GlideSearchConfig(), AdviseAction(), ENV)
    with pytest.raises(IzooError, match=r"add follower to env\.neighbours"):
        make_algorithm(GlideSearchConfig(), DirectAction(), EnvConfig(neighbours=("leader",)))
    with pytest.raises(IzooError, match="context_adoption"):
        make_algorithm(GlideSearchConfig(), DirectAction(), EnvConfig(observed=ENV.observed[1:]))
    assert [len(GATE)] * 2 == [len(start) for start in GATE_STARTS]
    assert make().policy.mean.shape[1] == len(SETTINGS) + len(GATE)


def test_vehicles_on_the_road_are_counted_by_their_cvs() -> None:
    rule = make().policy.rule
    frame = seen(1, ONE, adoption=0.5, length_m=200.0)
    rows = frame[base.OBSERVATION][0, :-1].clone()
    rule.environments = torch.zeros(6, dtype=torch.int64)
    # Six CVs, every second vehicle one, on one lane of 200 m.
    assert rule.traffic(rows).tolist() == pytest.approx([6.0] * 6)
    rows[0, NAMES.index("location_approaching")] = 0.0  # has crossed the line
    rows[1, NAMES.index("context_lane_length_m")] = 2.0  # comes on another approach, of 500 m
    assert rule.traffic(rows)[2:].tolist() == pytest.approx([4.0] * 4)
    assert float(rule.traffic(rows)[1]) == pytest.approx(0.4)
    rule.environments[2] = 1  # the same roads elsewhere
    assert rule.traffic(rows)[2:].tolist() == pytest.approx([1.0, 3.0, 3.0, 3.0])


def test_the_gate_hears_how_many_cvs_and_vehicles_there_are() -> None:
    algorithm = make()
    for name, column, much in (("adoption", "context_adoption", 1.0), ("traffic", "context_lane_length_m", 0.1)):
        algorithm.policy.mean.zero_()
        frame = seen(1, ONE)
        little = act(algorithm, frame)[DEFER]
        algorithm.policy.mean[0, len(SETTINGS) + GATE.index(name)] = -20.0
        frame[base.OBSERVATION][..., NAMES.index(column)] = much  # or a short road: crowded
        algorithm.policy.mean[0, [setting.name for setting in SETTINGS].index("stop_decel_mps2")] = 6.0
        assert not little.all()
        assert act(algorithm, frame)[DEFER].all()
