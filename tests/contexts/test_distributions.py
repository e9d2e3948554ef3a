import numpy as np
import pytest

from izoo.contexts.distributions import Box, Choice, Product, Uniform
from izoo.errors import IzooError


def test_weighted_frequencies():
    generator = np.random.default_rng(0)
    weighted = Choice(("a", "b", "c"), (0.2, 0.0, 0.8))
    draws = [weighted.sample(generator) for _ in range(4000)]
    assert draws.count("b") == 0
    assert draws.count("a") / 4000 == pytest.approx(0.2, abs=0.02)
    assert weighted.support == ("a", "c")


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Choice((1, 2), (-0.5, 1.5)), r"\[0, 1\]"),
        (lambda: Choice((1, 2), (1.0,)), "one probability per value"),
        (lambda: Uniform(float("nan"), 1.0), "not finite"),
        (lambda: Product({"x": [1, 2]}, (Box({"y": 1}),)), "unknown feature of an exclusion box 'y'"),
        (lambda: Product({"x": [1, 2]}, (Box({"x": (0, 3)}),)), "leaves nothing"),
        (lambda: Product({"x": Uniform(0, 1)}, (Box({"x": (0, 0.6)}), Box({"x": (0.5, 1)}))), "leaves nothing"),
        (lambda: Product({"x": 1, ("x", "y"): [(1, 2)]}), "twice"),
        (lambda: Product({("x", "y"): [(1, 2, 3)]}), "tuples of 2"),
        (lambda: len(Product({"x": Uniform(0, 1)})), "no length"),
    ],
)
def test_bad_input_is_named(build, message):
    with pytest.raises(IzooError, match=message):
        build()


def test_product_enumerates_with_the_last_feature_fastest():
    product = Product({"a": [1, 2], ("b", "c"): [(0, "x"), (1, "y")], "d": 5})
    assert len(product) == 4
    assert list(product) == [
        {"a": 1, "b": 0, "c": "x", "d": 5},
        {"a": 1, "b": 1, "c": "y", "d": 5},
        {"a": 2, "b": 0, "c": "x", "d": 5},
        {"a": 2, "b": 1, "c": "y", "d": 5},
    ]
    assert product[-1] == product[3]
    with pytest.raises(IndexError):
        product[4]


def test_exclusion_holds_in_sampling_and_enumeration():
    product = Product({"a": [1, 2, 3], "b": [1, 2]}, (Box({"a": (2, 3), "b": 2}),))
    assert [tuple(point.values()) for point in product] == [(1, 1), (1, 2), (2, 1), (3, 1)]
    generator = np.random.default_rng(1)
    draws = {tuple(product.sample(generator).values()) for _ in range(200)}
    assert draws == {(1, 1), (1, 2), (2, 1), (3, 1)}
