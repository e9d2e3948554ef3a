"""The batched module: parity with neuralmoves, masks, shapes, compilation."""

import math

import pytest
import torch

from izoo.emissions.classes import CLASSES
from izoo.emissions.moves import MovesSurrogate
from izoo.emissions.weights import load_weights
from izoo.errors import IzooError
from tests.emissions.reference import reference

MODULE = MovesSurrogate()


def states(*shape: int) -> list[torch.Tensor]:
    """Return speed, acceleration, grade and class of random vehicles."""
    generator = torch.Generator().manual_seed(1)
    speed, accel, grade = (torch.rand(*shape, generator=generator) * k for k in (20.0, 2.0, 5.0))
    return [speed, accel, grade, torch.randint(0, len(CLASSES), shape, generator=generator)]


def test_every_class_agrees_with_the_packages_own_api():
    ref = reference()
    inputs = (ref.speed_mps, ref.accel_mps2, ref.grade_pct, ref.moves_class, ref.temperature_c, ref.humidity_pct)
    rates = MODULE(*(torch.tensor(array) for array in inputs)).double()
    expected = torch.tensor(ref.rate_gps)
    assert rates.shape == expected.shape and expected.numel() == 99 * 200
    assert ((rates - expected).abs() / expected).max() <= 1e-4
    on_floor = expected == torch.tensor(load_weights().floor).double()[:, None]
    assert on_floor.any(dim=1).sum() > 50, "the sample must exercise the idling floor"
    assert (rates[on_floor].float() == torch.tensor(load_weights().floor)[:, None].expand(rates.shape)[on_floor]).all()


@pytest.mark.parametrize("count", [1, 3, 60, 800, 4096, 20_000])
def test_the_rate_of_a_vehicle_does_not_depend_on_the_batch(count):
    speed, accel, grade, classes = states(count)
    rates = MODULE(speed, accel, grade, classes, 20.0, 46.0)
    reversed_rates = MODULE(speed.flip(0), accel.flip(0), grade.flip(0), classes.flip(0), 20.0, 46.0).flip(0)
    single = torch.stack([MODULE(speed[k], accel[k], grade[k], classes[k], 20.0, 46.0) for k in range(min(count, 20))])
    torch.testing.assert_close(rates, reversed_rates, rtol=1e-5, atol=0.0)
    torch.testing.assert_close(rates[:20], single, rtol=1e-5, atol=0.0)


def test_arguments_broadcast():
    speed, accel, grade, classes = states(4, 3, 7)
    temperature, humidity = torch.tensor([0.0, 10.0, 20.0, 30.0])[:, None, None], torch.tensor(55.0)
    rates = MODULE(speed, accel, grade[0, 0], classes, temperature, humidity)
    assert rates.shape == (4, 3, 7) and rates.dtype == torch.float32
    torch.testing.assert_close(rates[2, 1], MODULE(speed[2, 1], accel[2, 1], grade[0, 0], classes[2, 1], 20.0, 55.0))


@pytest.mark.parametrize("shape", [(0,), (3, 0), (2, 5)])
def test_nothing_to_compute_gives_zeros(shape):
    mask = torch.zeros(shape, dtype=torch.bool)
    assert torch.equal(MODULE(*states(*shape), 20.0, 46.0, mask), torch.zeros(shape))


def noisy(mask: torch.Tensor, arguments: list[torch.Tensor]) -> list[torch.Tensor]:
    """Return the arguments with NaN, infinities and impossible classes where ``mask`` is false."""
    speed, accel, grade, classes = (argument.clone() for argument in arguments)
    speed[~mask], accel[~mask], grade[~mask], classes[~mask] = math.nan, math.inf, -1e30, 10**12
    return [speed, accel, grade, classes]


def test_noise_in_empty_slots_changes_nothing():
    clean = states(8, 40)
    mask = torch.rand(8, 40, generator=torch.Generator().manual_seed(2)) < 0.4
    rates = MODULE(*noisy(mask, clean), 20.0, 46.0, mask)
    assert torch.equal(rates, MODULE(*clean, 20.0, 46.0, mask))
    assert (rates[~mask] == 0.0).all() and (rates[mask] > 0.0).all()


def test_electric_vehicles_emit_exactly_nothing():
    clean = states(8, 40)
    electric = torch.rand(8, 40, generator=torch.Generator().manual_seed(3)) < 0.3
    mask = torch.rand(8, 1, generator=torch.Generator().manual_seed(4)) < 0.8
    rates = MODULE(*clean, 20.0, 46.0, mask, electric)
    assert torch.equal(rates != 0.0, mask & ~electric)
    assert torch.equal(MODULE(*clean, 20.0, 46.0, electric=electric) != 0.0, ~electric)


def test_a_class_outside_the_table_is_an_error():
    speed, accel, grade, classes = states(5)
    classes[3] = 99
    with pytest.raises(IzooError, match=r"run from \d+ to 99; they must lie in \[0, 98\]"):
        MODULE(speed, accel, grade, classes, 20.0, 46.0)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_agrees_with_cpu():
    clean = states(64, 100)
    mask = torch.rand(64, 100, generator=torch.Generator().manual_seed(6)) < 0.5
    device = MovesSurrogate().cuda()
    rates = device(*(argument.cuda() for argument in noisy(mask, clean)), 20.0, 46.0, mask.cuda())
    torch.testing.assert_close(rates.cpu(), MODULE(*clean, 20.0, 46.0, mask), rtol=1e-4, atol=0.0)


def test_rates_can_be_differentiated():
    speed, accel, grade, classes = states(50)
    accel.requires_grad_()
    MODULE(speed, accel, grade, classes, 20.0, 46.0).sum().backward()
    assert accel.grad is not None and accel.grad.isfinite().all() and accel.grad.abs().sum() > 0
