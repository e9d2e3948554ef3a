"""The distribution of advice: its point mass, its density and its entropy, by hand and by counting."""

import math

import numpy as np
import pytest
import torch

from izoo.algos.actions.action_modes import PointMass
from izoo.algos.networks import compiled_mlp
from izoo.algos.networks.censored_normal import CensoredNormal
from izoo.errors import IzooError

BOUND, DEAD = 0.8, 0.7


def phi(z: float) -> float:
    return 0.5 * math.erfc(-z / math.sqrt(2.0))


def make(loc: float, scale: float, two_sided: bool) -> CensoredNormal:
    flag = torch.tensor([two_sided])
    return CensoredNormal(torch.full((1, 1), loc), torch.full((1, 1), scale), BOUND, DEAD, flag)


@pytest.mark.parametrize(("loc", "scale"), [(0.0, 0.5), (-0.4, 0.3), (1.3, 0.6), (-2.0, 0.7)])
@pytest.mark.parametrize("two_sided", [False, True])
def test_probabilities_equal_a_hand_computation(loc: float, scale: float, two_sided: bool) -> None:
    distribution = make(loc, scale, two_sided)
    rest = phi((DEAD - loc) / scale) - (phi((-DEAD - loc) / scale) if two_sided else 0.0)
    assert float(distribution.log_prob(torch.zeros(1, 1))) == pytest.approx(math.log(rest), abs=1e-5)
    for advice in (0.3, -0.3) if two_sided else (0.3,):
        raw = math.atanh(abs(advice) / BOUND) + DEAD
        z = (math.copysign(raw, advice) - loc) / scale
        density = math.exp(-0.5 * z * z) / (scale * math.sqrt(2 * math.pi)) / (BOUND * (1 - (advice / BOUND) ** 2))
        assert float(distribution.log_prob(torch.full((1, 1), advice))) == pytest.approx(math.log(density), abs=1e-4)


@pytest.mark.parametrize("two_sided", [False, True])
def test_the_mass_and_the_density_add_up_to_one(two_sided: bool) -> None:
    distribution = make(0.2, 0.6, two_sided)
    advice = torch.linspace(-BOUND, BOUND, 200_001)[1:-1].view(-1, 1, 1)
    density = torch.where(advice == 0, 0.0, distribution.log_prob(advice).exp().unsqueeze(-1))
    if not two_sided:
        density = torch.where(advice < 0, 0.0, density)
    total = torch.trapezoid(density[:, 0, 0], advice[:, 0, 0]) + distribution.log_prob(torch.zeros(1, 1)).exp()
    assert float(total) == pytest.approx(1.0, abs=2e-4)


@pytest.mark.parametrize("two_sided", [False, True])
def test_draws_rest_as_often_as_they_say(two_sided: bool) -> None:
    distribution = make(0.1, 0.5, two_sided)
    torch.manual_seed(0)
    draws = distribution.sample(torch.Size([40_000]))
    assert float((draws == 0).float().mean()) == pytest.approx(float(distribution.zero_log_prob().exp()), abs=0.01)
    assert bool((draws < 0).any()) == two_sided
    assert float(draws.abs().max()) < BOUND


@pytest.mark.parametrize("two_sided", [False, True])
def test_the_gradient_of_resting_is_that_of_its_probability(two_sided: bool) -> None:
    """However far the policy is from resting: the drawn value behind it plays no part, and nothing overflows."""
    for loc in (-30.0, -1.0, 0.0, 2.0, 30.0):
        point = torch.full((1, 1), loc, requires_grad=True)
        scale = torch.full((1, 1), 0.4, requires_grad=True)
        CensoredNormal(point, scale, BOUND, DEAD, torch.tensor([two_sided])).log_prob(
            torch.zeros(1, 1)
        ).sum().backward()
        assert point.grad is not None and scale.grad is not None
        assert point.grad.isfinite().all() and scale.grad.isfinite().all()
        step = 1e-3
        rise = [float(make(loc + s, 0.4, two_sided).zero_log_prob().double()) for s in (step, -step)]
        assert float(point.grad) == pytest.approx((rise[0] - rise[1]) / (2 * step), abs=0.02, rel=0.02)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("loc", [0.3, 4.5, 8.45, 30.0])
def test_the_strongest_action_has_the_probability_of_all_that_stands_for_it(loc: float, side: float) -> None:
    """A policy far beyond it, with little spread, would else find its own draws impossible, and ratios overflow."""
    point, scale = torch.full((1, 1), side * loc, requires_grad=True), torch.full((1, 1), 0.5, requires_grad=True)
    distribution = CensoredNormal(point, scale, BOUND, DEAD, torch.tensor([True]))
    strongest = distribution.censor(torch.full((1, 1), side * 30.0))
    found = distribution.log_prob(strongest)
    assert float(found.detach()) == pytest.approx(
        float(torch.special.log_ndtr(torch.tensor((loc - 4.0 - DEAD) / 0.5))), rel=1e-4, abs=1e-6
    )
    found.sum().backward()
    assert point.grad is not None and scale.grad is not None
    assert bool(point.grad.isfinite()) and bool(scale.grad.isfinite()) and float(side * point.grad) >= 0.0
    assert float(distribution.log_prob(0.99 * strongest).detach()) != pytest.approx(float(found.detach()), abs=0.1)


@pytest.mark.parametrize("two_sided", [False, True])
def test_entropy_equals_a_count(two_sided: bool) -> None:
    """In the coordinates before the tanh, by a sum over a fine grid."""
    loc, scale = 0.3, 0.5
    x = torch.linspace(loc - 8 * scale, loc + 8 * scale, 400_001, dtype=torch.float64)
    density = torch.exp(-0.5 * ((x - loc) / scale) ** 2) / (scale * math.sqrt(2 * math.pi))
    acts = (x > DEAD) | ((x < -DEAD) & two_sided)
    surprise = torch.where(acts, -density * density.log(), 0.0)
    rest = float(torch.trapezoid(torch.where(acts, 0.0, density), x))
    expected = float(torch.trapezoid(surprise, x)) - rest * math.log(rest)
    assert float(make(loc, scale, two_sided).entropy()) == pytest.approx(expected, abs=1e-3)


def test_compiled_draws_equal_the_modules() -> None:
    generator = torch.Generator().manual_seed(1)
    n = 500
    loc, offset = 4.0 * torch.randn(n, generator=generator), torch.randn(n, generator=generator)
    two_sided, noise = torch.rand(n, generator=generator) < 0.5, torch.randn(n, generator=generator)
    parameters = torch.stack([loc, offset], dim=-1).numpy()
    out, rows = np.zeros((4, n), np.float32), np.arange(n)
    squashing = compiled_mlp.Squashing((0.5, 0.0, 0.01), (-BOUND, BOUND), DEAD)
    compiled_mlp.sample(parameters, rows, squashing, two_sided.numpy().view(np.uint8), noise.numpy(), out)
    scale = torch.nn.functional.softplus(offset + 0.5).clamp_min(0.01)
    distribution = CensoredNormal(loc.unsqueeze(-1), scale.unsqueeze(-1), BOUND, DEAD, two_sided)
    action = distribution.censor((loc + scale * noise).unsqueeze(-1))
    assert 50 < int((action == 0).sum()) < 450 and int((action.abs() > 0.7993).sum()) > 50
    torch.testing.assert_close(torch.from_numpy(out[2]), action.squeeze(-1), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(torch.from_numpy(out[3]), distribution.log_prob(action), atol=2e-3, rtol=1e-3)


def test_far_tails_of_the_compiled_distribution_function() -> None:
    for z in (-60.0, -31.0, -29.0, -8.0, 0.0, 3.0):
        exact = float(torch.special.log_ndtr(torch.tensor(z, dtype=torch.float64)))
        assert compiled_mlp.log_cdf(z) == pytest.approx(exact, rel=1e-5, abs=1e-12)


def test_the_band_holds_what_an_untrained_policy_says() -> None:
    assert phi(-PointMass(act_share=0.08, spread=0.35).half_band / 0.35) == pytest.approx(0.08)
    with pytest.raises(IzooError, match="act_share"):
        PointMass(act_share=0.0)
