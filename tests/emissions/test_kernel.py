"""The compiled kernel: parity with neuralmoves and with the module, slots, speed."""

import numpy as np
import pytest
import torch

from izoo.emissions.classes import CLASSES
from izoo.emissions.kernel import emission_rate_kernel, load_weights
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


@pytest.mark.parametrize("dtype", [bool, np.uint8])
def test_kernel_and_module_are_the_same_function(dtype):
    arguments = states(200)
    active = np.random.default_rng(1).random(200) < 0.6
    module = MovesSurrogate()(*(torch.tensor(a) for a in arguments), -3.0, 80.0, torch.tensor(active))
    rates = rates_of(arguments, active.astype(dtype), -3.0, 80.0)
    np.testing.assert_allclose(rates, module.numpy(), rtol=2e-5, atol=0.0)


@pytest.mark.parametrize("wrong", [-1, 99])
def test_a_class_outside_the_table_is_an_error(wrong):
    arguments = states(5)
    arguments[3][2] = wrong
    with pytest.raises(IndexError, match="outside CLASSES"):
        rates_of(arguments, np.ones(5, bool))
