"""Scripted drivers write what an environment reads, and glide gives the advice that a hand calculation gives."""

import pytest
import torch
from tensordict import TensorDict

from izoo.algos.drivers.by_name import DRIVERS, make_driver
from izoo.algos.drivers.constant import ConstantSpeed
from izoo.algos.drivers.glide import Glide, GlideConfig
from izoo.algos.drivers.random import RandomDriver
from izoo.algos.drivers.uncommanded import UncommandedDriver
from izoo.algos.learners.registry import DRIVER_NAMES
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.envs.mdp.observation import FAR_M
from izoo.errors import IzooError
from tests.algos.frames import observed

CONFIG = EnvConfig()
NAMES = observation_names(CONFIG)


def make_step(n: int = 2, a: int = 3) -> TensorDict:
    return TensorDict({"agents": TensorDict({"mask": torch.ones(n, a, dtype=torch.bool)}, [n, a])}, [n])


def observation(**values: float) -> torch.Tensor:
    """An approaching CV, 200 m before a red light, alone at 15 m/s; ``[F]``, ``values`` in SI units."""
    seen = {"speed": 15.0, "stop_line_distance": -200.0, "location_approaching": 1.0, "leader_distance": FAR_M}
    seen |= {"signal_red": 1.0, "signal_time_left": 20.0, "signal_second_green": 80.0, "signal_third_green": 140.0}
    seen |= {"context_green_s": 30.0, "context_red_s": 30.0, "context_speed_limit_mps": 15.0, "context_lane_count": 1.0}
    return observed(CONFIG, **(seen | values))


def as_step(*rows: torch.Tensor) -> TensorDict:
    a = len(rows)
    agents = {"observation": torch.stack(rows), "mask": torch.ones(a, dtype=torch.bool)}
    return TensorDict({"agents": TensorDict(agents, [a])}, [])


def advise(*rows: torch.Tensor, settings: GlideConfig | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    step = Glide(CONFIG, settings)(as_step(*rows))
    return step["agents", "action"].squeeze(-1), step["agents", "defer"]


def test_random_driver_covers_the_range_and_follows_torchs_generator() -> None:
    draws = []
    for _ in range(2):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(3)
            draws.append(RandomDriver()(make_step(50, 40))["agents", "action"])
    assert draws[0].shape == (50, 40, 1) and torch.equal(*draws)
    assert -4.5 <= float(draws[0].min()) < -4.3 and 2.4 < float(draws[0].max()) <= 2.6


def test_constant_speeds_and_accelerations_and_no_command() -> None:
    """A speed is reached in one step, within the bounds; an acceleration is the same whatever is seen."""
    seen = as_step(observation(speed=9.5), observation(speed=0.0), observation(speed=15.0))
    cases = {make_driver("constant_2.0", CONFIG): [2.0, 2.0, 2.0], ConstantSpeed(CONFIG, 10.0): [1.0, 2.6, -4.5]}
    for driver, expected in cases.items():
        step = driver(seen.clone())
        assert step["agents", "action"].squeeze(-1).tolist() == pytest.approx(expected, abs=1e-5)
        assert not step["agents", "defer"].any()
    step = UncommandedDriver()(make_step())
    assert bool(step["agents", "defer"].all()) and step["agents", "action"].shape == (2, 3, 1)


def test_a_speed_cap_brakes_what_is_faster_and_leaves_the_slower_alone() -> None:
    assert make_driver("cap_1", CONFIG)(as_step(observation(), observation(speed=3.0)))["agents", "defer"].all()
    step = make_driver("cap_0.6", CONFIG)(as_step(*(observation(speed=v) for v in (15.0, 9.5, 9.0, 8.0, 7.0, 0.0))))
    assert step["agents", "action"].squeeze(-1).tolist()[:4] == pytest.approx([-1.5, -0.5, 0.0, 1.0], abs=1e-5)
    assert step["agents", "defer"].tolist() == [False, False, False, False, True, True]


@pytest.mark.parametrize("name", ["cap_0", "cap_1.2", "cap_-1", "cap_x", "cap_", "cap_nan"])
def test_a_cap_that_is_no_share_is_refused(name: str) -> None:
    with pytest.raises(IzooError, match="share of the limit above 0 and up to 1"):
        make_driver(name, CONFIG)


@pytest.mark.parametrize("name", DRIVERS)
def test_every_driver_writes_the_action_keys_and_ignores_padding(name: str) -> None:
    driver = make_driver(name, CONFIG)
    step = TensorDict({"agents": TensorDict(batch_size=[2, 4])}, [2])
    step["agents", "mask"] = torch.tensor([[True, False, True, False], [False, False, True, True]])
    clean = torch.randn(2, 4, len(NAMES), generator=torch.Generator().manual_seed(0))
    results = []
    for noise in (0.0, float("nan")):
        observed = torch.where(step["agents", "mask"].unsqueeze(-1), clean, torch.full_like(clean, noise))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            results.append(driver(step.clone().set(("agents", "observation"), observed)))
    for result in results:
        assert result["agents", "action"].shape == (2, 4, 1)
        assert result["agents", "action"].isfinite().all()
    mask = step["agents", "mask"]
    assert torch.equal(results[0]["agents", "action"][mask], results[1]["agents", "action"][mask])


def test_unknown_driver_names_the_nearest() -> None:
    assert tuple(DRIVERS) == DRIVER_NAMES
    with pytest.raises(IzooError, match="Did you mean 'glide'"):
        make_driver("glied", CONFIG)


def test_glide_arrives_when_the_first_vehicle_of_the_green_may_pass() -> None:
    """Green in 20 s, start lag 2 s: 200 m in 22 s is 9.1 m/s; from 15 m/s within 2 s, braking at most 1 m/s^2."""
    accel, idle = advise(observation(), observation(speed=9.5))
    assert idle.tolist() == [False, False]
    assert accel.tolist() == pytest.approx([-1.0, (200 / 22 - 9.5) / 2.0], abs=1e-4)


def test_glide_waits_for_the_queue_and_skips_a_green_that_it_uses_up() -> None:
    driver = Glide(CONFIG)
    behind = [observation(leader_present=1.0, leader_distance=distance_m) for distance_m in (200.0 - 7.5, 80.0)]
    rows = torch.stack([observation(), *behind])
    distance = torch.full((3,), 200.0)
    queue = driver.queue_ahead(rows, distance)
    assert queue.tolist() == pytest.approx([0.0, 2.0, 1.0 + 120.0 / 7.5], abs=1e-4)
    passing = driver.passing_time(rows, distance, distance / 15.0)
    served = (30.0 - 2.0) / 2.2
    expected = [22.0, 22.0 + 2 * 2.2, 80.0 + 2.0 + 2.2 * (17.0 - served)]
    assert passing.tolist() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    "values",
    [
        {"signal_red": 0.0, "signal_green": 1.0, "signal_time_left": 25.0},  # it makes the current green
        {"stop_line_distance": -10.0},  # too near
        {"stop_line_distance": 30.0, "location_approaching": 0.0, "location_leaving": 1.0},  # already past
        {"leader_present": 1.0, "leader_distance": 10.0, "leader_speed": 15.0},  # following closely
        {"stop_line_distance": -320.0, "signal_time_left": 19.0},  # would be early by less than two seconds
        {"context_lane_count": 2.0},  # cannot know which lane others choose
        {"context_green_s": 8.0, "context_red_s": 32.0},  # 20 % of green: too little is discharged
    ],
)
def test_glide_leaves_alone_vehicles_that_need_not_slow(values: dict[str, float]) -> None:
    assert advise(observation(**values))[1].tolist() == [True]


def test_glide_drives_on_wider_approaches_and_before_short_greens_when_told_to() -> None:
    assert advise(observation(context_lane_count=2.0), settings=GlideConfig(max_lanes=2))[1].tolist() == [False]
    row = observation(context_green_s=13.0, context_red_s=47.0)
    assert advise(row)[1].tolist() == [True]
    assert advise(row, settings=GlideConfig(min_green_share=0.2))[1].tolist() == [False]


@pytest.mark.parametrize(
    ("values", "decel"),
    [
        # 10 m/s and 60 m to the line: 0.83 m/s^2 stops there in 12 s, which the red light outlasts, or does not.
        ({"stop_line_distance": -60.0, "signal_time_left": 30.0}, 100.0 / 120.0),
        ({"stop_line_distance": -60.0, "signal_time_left": 11.0}, None),
        # 100 m away braking would be gentler than it need be, and in the last metres it is the simulator's.
        ({"stop_line_distance": -100.0, "signal_time_left": 30.0}, None),
        ({"stop_line_distance": -4.0, "signal_time_left": 30.0, "speed": 4.0}, None),
        # A leader that stands 43 m ahead, of which 3 m are to be left; a queue that green will move ends no journey.
        ({"leader_present": 1.0, "leader_distance": 43.0, "leader_speed": 0.0, "signal_time_left": 9.0}, 100.0 / 80.0),
        ({"leader_present": 1.0, "leader_distance": 43.0, "leader_speed": 0.0, "signal_time_left": 7.0}, None),
        ({"leader_present": 1.0, "leader_distance": 43.0, "leader_speed": 9.0, "signal_time_left": 9.0}, None),
        # One that stands beyond the line is further away than the line.
        (
            {"stop_line_distance": -60.0, "leader_present": 1.0, "leader_distance": 140.0, "signal_time_left": 30.0},
            5 / 6,
        ),
    ],
)
def test_glide_brakes_early_on_wider_roads_where_a_stop_is_certain(
    values: dict[str, float], decel: float | None
) -> None:
    row = observation(**{"context_lane_count": 2.0, "speed": 10.0, "signal_green": 0.0, "signal_red": 1.0} | values)
    accel, defer = advise(row)
    assert defer.tolist() == [decel is None]
    if decel is not None:
        assert float(accel) == pytest.approx(-decel, abs=1e-3)
    assert advise(row, settings=GlideConfig(stop_decel_mps2=0.0))[1].tolist() == [True]


def test_glide_never_advises_below_its_floor() -> None:
    row = observation(speed=4.0, signal_time_left=60.0, signal_second_green=120.0)
    accel, idle = advise(row)
    assert not idle.any()
    assert accel.tolist() == pytest.approx([0.0], abs=1e-5)


def test_glide_refuses_an_observation_that_lacks_what_it_needs() -> None:
    with pytest.raises(IzooError, match="leader_present"):
        Glide(EnvConfig(neighbours=("follower",)))
    with pytest.raises(IzooError, match="context_green_s"):
        Glide(EnvConfig(observed=("adoption",)))
