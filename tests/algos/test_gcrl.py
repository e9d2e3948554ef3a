"""Graph RL: the graph and its attention by hand, how far information travels, and a real run."""

import math

import pytest
import torch

from izoo.algos.learners import graph_ppo
from izoo.algos.learners.graph_ppo import GCRL, STOP_LINE_DISTANCE, Bins, Convolution, GCRLConfig, GraphNetwork
from izoo.algos.networks.set_networks import places
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.envs.mdp.observation import DISTANCE_SCALE_M
from tests.algos.frames import FEATURES, SPACE, shake

POSITIONS = torch.tensor([-100.0, -90.0, -60.0, 0.0, 0.0, 30.0])
EVERYONE = torch.ones(6, dtype=torch.bool)


def neighbourhood(
    position_m: torch.Tensor, mask: torch.Tensor, count: int | None, range_m: float | None
) -> torch.Tensor:
    others = mask.unsqueeze(-1) & mask.unsqueeze(-2) & ~torch.eye(len(mask), dtype=torch.bool)
    return graph_ppo.neighbourhood(position_m, others, graph_ppo.reach_m(position_m, others, count, range_m))


def sets(attended: torch.Tensor) -> list[set[int]]:
    return [set(row.nonzero()[:, 0].tolist()) for row in attended]


def test_neighbours_are_the_nearest_and_those_in_range() -> None:
    assert sets(neighbourhood(POSITIONS, EVERYONE, 1, None)) == [{0, 1}, {0, 1}, {1, 2}, {3, 4}, {3, 4}, {3, 4, 5}]
    assert sets(neighbourhood(POSITIONS, EVERYONE, 2, None))[2] == {0, 1, 2}
    assert sets(neighbourhood(POSITIONS, EVERYONE, None, 30.0)) == [{0, 1}, {0, 1, 2}, {1, 2}, *[{3, 4, 5}] * 3]
    assert sets(neighbourhood(POSITIONS, EVERYONE, 4, 5.0))[5] == {5}, "a vehicle without neighbours has itself"
    # All inside the junction are at 0; the order of the slots must not choose among them.
    inside = torch.tensor([0.0, 0.0, 0.0, -10.0])
    assert sets(neighbourhood(inside, torch.ones(4, dtype=torch.bool), 1, None)) == [{0, 1, 2}] * 3 + [{0, 1, 2, 3}]
    assert observation_names(EnvConfig())[STOP_LINE_DISTANCE] == "stop_line_distance"


def test_empty_slots_are_nobodys_neighbours() -> None:
    mask = torch.tensor([True, False, True, True, False, True])
    attended = neighbourhood(POSITIONS, mask, 2, None)
    assert sets(attended[mask]) == [{0, 2, 3}, {0, 2, 3}, {2, 3, 5}, {2, 3, 5}]
    assert sets(attended[~mask]) == [{1}, {4}]
    assert sets(neighbourhood(POSITIONS, EVERYONE, 0, None)) == [{k} for k in range(6)]
    assert sets(neighbourhood(POSITIONS, EVERYONE, None, None)) == [set(range(6))] * 6


def test_a_convolution_equals_a_hand_computation() -> None:
    """Multi-head dot-product attention, in plain Python."""
    torch.manual_seed(1)
    convolution = Convolution(width=6, heads=2, activation="tanh")
    encoding = torch.randn(4, 6)
    attended = torch.tensor([[1, 1, 0, 0], [1, 1, 1, 0], [0, 0, 1, 0], [1, 0, 1, 1]], dtype=torch.bool)
    with torch.no_grad():
        unattended = torch.zeros(1, 4, 4).masked_fill(~attended, -math.inf)
        found = convolution(encoding, Bins(torch.zeros(4, dtype=torch.long), torch.arange(4)), unattended)
        query, key, value = convolution.project(encoding).split(6, dim=-1)
        for i in range(4):
            mixed = []
            for head in (slice(0, 3), slice(3, 6)):
                members = attended[i].nonzero()[:, 0].tolist()
                scores = [math.exp(float(query[i, head] @ key[j, head]) / math.sqrt(3)) for j in members]
                mixed.append(sum(s / sum(scores) * value[j, head] for s, j in zip(scores, members, strict=True)))
            torch.testing.assert_close(found[i], convolution.combine(torch.cat(mixed)), atol=1e-5, rtol=1e-5)


def make_network(**changes: object) -> GraphNetwork:
    torch.manual_seed(4)
    config = GCRLConfig(**{"hidden": (8, 8), "heads": 2, "neighbours": None, "range_m": 50.0, **changes})  # type: ignore[arg-type]
    return GraphNetwork(FEATURES, 1, config, last_gain=1.0)


@pytest.mark.parametrize("layers", [1, 2])
def test_information_travels_one_hop_per_layer(layers: int) -> None:
    """Vehicles 40 m apart on a line, within 50 m of each other: a change reaches ``layers`` vehicles along."""
    network = make_network(layers=layers)
    observation = torch.randn(5, FEATURES)
    observation[:, STOP_LINE_DISTANCE] = torch.arange(5) * -40.0 / DISTANCE_SCALE_M
    changed = observation.clone()
    changed[0, 0] += 1.0
    with torch.no_grad():
        moved = (network(observation, EVERYONE[:5]) - network(changed, EVERYONE[:5])).abs().squeeze(-1) > 1e-6
    assert moved.tolist() == [k <= layers for k in range(5)]


def test_a_lonely_vehicle_is_as_if_alone() -> None:
    network = make_network()
    observation = torch.randn(3, FEATURES)
    observation[:, STOP_LINE_DISTANCE] = torch.tensor([-200.0, -100.0, 0.0]) / DISTANCE_SCALE_M
    with torch.no_grad():
        together = network(observation, EVERYONE[:3])
        apart = torch.cat([network(observation[k : k + 1], EVERYONE[:1]) for k in range(3)])
    torch.testing.assert_close(together, apart)


CROWD = torch.Generator().manual_seed(6)
CROWDED = torch.rand(12, 9, generator=CROWD) < torch.rand(12, 1, generator=CROWD)
"""Twelve frames of nine slots, from nearly empty to nearly full."""


def make_crowd() -> torch.Tensor:
    """Observations of :data:`CROWDED`, some of them equally far away; what is not a number stands in empty slots."""
    observation = torch.randn(12, 9, FEATURES, generator=torch.Generator().manual_seed(2))
    steps = torch.randint(0, 12, (12, 9), generator=torch.Generator().manual_seed(3))
    observation[..., STOP_LINE_DISTANCE] = steps * -20.0 / DISTANCE_SCALE_M
    return observation.masked_fill(~CROWDED.unsqueeze(-1), float("nan"))


@pytest.mark.parametrize("bin_rows", [1, 4, 1000])
def test_frames_in_bins_are_as_if_alone(bin_rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graph_ppo, "BIN_ROWS", bin_rows)
    network, observation = make_network(neighbours=2), make_crowd()
    frame, column = places(CROWDED)
    bins = Bins(frame, column)
    assert torch.equal(bins.unpack(bins.pack(frame)), frame)
    assert sorted(bins.slot.tolist()) == bins.slot.unique().tolist(), "a slot for each"
    with torch.no_grad():
        together = network(observation, CROWDED)
        for number in CROWDED.any(-1).nonzero()[:, 0].tolist():
            members = observation[number][CROWDED[number]]
            alone = network(members, torch.ones(len(members), dtype=torch.bool))
            torch.testing.assert_close(together[number][CROWDED[number]], alone)
        shuffled = torch.randperm(len(frame), generator=torch.Generator().manual_seed(1))
        rows = network.rows(observation[CROWDED][shuffled], frame[shuffled], column[shuffled])
    torch.testing.assert_close(rows, together[CROWDED][shuffled])


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"neighbours": 1, "range_m": None, "activation": "relu", "hidden": (8,)},
        {"neighbours": 3, "range_m": 40.0, "activation": "silu", "hidden": (7, 5, 12), "heads": 3, "layers": 1},
        {"neighbours": None, "range_m": None},
        {"neighbours": None, "range_m": 60.0},
        {"neighbours": 0},
    ],
)
def test_a_policy_sees_its_own_frame_alone(changes: dict[str, object]) -> None:
    """For whoever is there, in any slot, whatever stands in the empty ones and whoever is in other frames."""
    torch.manual_seed(5)
    config = GCRLConfig(**{"hidden": (16, 16), **changes})  # type: ignore[arg-type]
    policy, observation = GCRL(config, FEATURES, SPACE).policy, make_crowd()
    noise = torch.randn(12, 9, generator=torch.Generator().manual_seed(8))
    shake(policy, 0.2)
    with torch.no_grad():
        together = policy.sample(observation, CROWDED, noise)
        order = torch.tensor([3, 8, 0, 5, 1, 2, 7, 6, 4])
        turned = policy.sample(observation[:, order], CROWDED[:, order], noise[:, order])
        for frame in range(12):
            alone = policy.sample(observation[frame], CROWDED[frame], noise[frame])
            torch.testing.assert_close(alone, together[:, frame], atol=2e-5, rtol=2e-5)
    torch.testing.assert_close(turned, together[..., order], atol=2e-5, rtol=2e-5)
    assert (together[:, ~CROWDED] == torch.tensor([[0.0], [1.0], [0.0], [0.0]])).all()
    assert policy.sample(observation, CROWDED, noise).requires_grad
