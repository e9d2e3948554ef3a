import pytest

from izoo.contexts.features import OBSERVED, check_observed
from izoo.errors import IzooError


def test_observed_features_have_the_documented_order():
    first = ("adoption", "green_s", "red_s", "temperature_c", "humidity_pct", "engine")
    assert (*first, "lane_count", "lane_length_m", "speed_limit_mps") == OBSERVED
    # A selection comes back in this order.
    assert check_observed(["engine", "adoption"]) == ("adoption", "engine")


@pytest.mark.parametrize(
    "name", ["driver_aggressiveness", "fleet", "arrivals", "turning", "offset_s", "grade", "inflow_vph_per_lane"]
)
def test_unobserved_features_are_refused_with_the_reason(name):
    with pytest.raises(IzooError, match=f"'{name}' cannot be observed: .+ Observable features: adoption"):
        check_observed([name])


def test_unknown_and_repeated_names_are_refused():
    with pytest.raises(IzooError, match="Did you mean 'green_s'"):
        check_observed(["greens"])
    with pytest.raises(IzooError, match="once"):
        check_observed(["engine", "engine"])
