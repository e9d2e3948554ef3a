"""The compiled kernel: parity with neuralmoves and with the module, slots, speed."""

import numpy as np
import pytest
import torch

from izoo.emissions.classes import CLASSES
from izoo.emissions.kernel import emission_rate_kernel, fast_tanh, load_weights
from izoo.emissions.moves import MovesSurrogate

WEIGHTS = load_weights()


def states(count: int, seed: int = 0) -> list[np.ndarray]:
    """Return speed, acceleration, grade and class of random vehicles."""
    generator = np.random.default_rng(seed)
    bounds = ((0.0, 20.0), (-4.5, 2.6), (-6.0, 6.0))
    floats = [generator.uniform(low, high, count).astype(np.float32) for low, high in bounds]
    return [*floats, generator.integers(0, len(CLASSES), count)]


def rates_of(
    arguments: list[np.ndarray], active: np.ndarray, temperature: float = 20.0, humidity: float = 46.0
) -> np.ndarray:
    out = np.full(len(active), np.nan, np.float32)
    emission_rate_kernel(*arguments, active, temperature, humidity, WEIGHTS, out)
    return out


def test_tanh_is_accurate_over_its_whole_range():
    x = np.concatenate([np.linspace(-20, 20, 40_001), np.geomspace(1e-20, 100, 2_000)]).astype(np.float32)
    got = np.array([fast_tanh(value) for value in x])
    np.testing.assert_allclose(got, np.tanh(x.astype(np.float64)), rtol=1e-6, atol=0.0)
    assert fast_tanh(np.float32(np.inf)) == pytest.approx(1.0) and fast_tanh(np.float32(-np.inf)) == pytest.approx(-1.0)
    assert np.isnan(fast_tanh(np.float32(np.nan)))


@pytest.mark.parametrize("dtype", [bool, np.uint8])
def test_kernel_and_module_are_the_same_function(dtype):
    arguments = states(200)
    active = np.random.default_rng(1).random(200) < 0.6
    module = MovesSurrogate()(*(torch.tensor(a) for a in arguments), -3.0, 80.0, torch.tensor(active))
    rates = rates_of(arguments, active.astype(dtype), -3.0, 80.0)
    np.testing.assert_allclose(rates, module.numpy(), rtol=2e-5, atol=0.0)


def test_noise_in_inactive_slots_changes_nothing():
    clean, active = states(100), np.random.default_rng(2).random(100) < 0.5
    speed, accel, grade, classes = (array.copy() for array in clean)
    speed[~active], accel[~active], grade[~active], classes[~active] = np.nan, np.inf, -1e30, 10**12
    rates = rates_of([speed, accel, grade, classes], active)
    np.testing.assert_array_equal(rates, rates_of(clean, active))
    assert (rates[~active] == 0.0).all() and (rates[active] > 0.0).all()


@pytest.mark.parametrize("wrong", [-1, 99])
def test_a_class_outside_the_table_is_an_error(wrong):
    arguments = states(5)
    arguments[3][2] = wrong
    with pytest.raises(IndexError, match="outside CLASSES"):
        rates_of(arguments, np.ones(5, bool))
