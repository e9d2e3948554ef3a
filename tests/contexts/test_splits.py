import hashlib

import numpy as np
import pytest

from izoo.contexts.cities.rebuilt import CITIES, SIZES
from izoo.contexts.protocols import in_distribution, productivity, systematicity
from izoo.contexts.splits import OOD_PAIRS, SPLITS, city_split, split_names
from izoo.errors import IzooError

# The test sets. These must never change: published scores depend on them.
GOLDEN_TEST_SETS = {
    "atlanta": "d9271adb8d4289d0",
    "boston": "ae0b8bb0c6be6e3e",
    "chicago": "570feafbb4d95616",
    "dallas_fort_worth": "28db764e39624bfe",
    "houston": "0cce2aa7f6c47e46",
    "los_angeles": "27c46d265bfc2bf7",
    "salt_lake_city": "8902d6ccdbd5765e",
    "new_york_manhattan": "483eed5a49e7af1a",
    "san_francisco": "5c30d7ce68868db6",
    "seattle": "fe75d3786764fc5c",
}


@pytest.mark.parametrize("city", CITIES)
def test_splits_partition_a_city_and_never_change(city):
    digest = hashlib.sha256(repr(city_split(city, "test")).encode()).hexdigest()
    assert digest[:16] == GOLDEN_TEST_SETS[city]
    parts = [city_split(city, split) for split in SPLITS]
    assert sorted(sum(parts, ())) == list(range(SIZES[city])) == list(city_split(city))
    assert len(parts[1]) == len(parts[2]) == int(SIZES[city] / 10 + 0.5)


def test_any_set_of_names_can_be_split():
    names = [f"my-town/{index}" for index in range(43)]
    parts = split_names(names)
    assert [len(parts[split]) for split in SPLITS] == [35, 4, 4]
    assert {s: set(v) for s, v in split_names(names[::-1]).items()} == {s: set(v) for s, v in parts.items()}
    assert split_names(["only"])["train"] == ("only",)
    with pytest.raises(IzooError, match="repeat"):
        split_names(["a", "a"])
    with pytest.raises(IzooError, match="unknown split"):
        city_split("atlanta", "dev")


def test_in_distribution_sets_do_not_share_intersections():
    sets = in_distribution("salt_lake_city")
    groups = [
        {part.locate(i)[0].intersection for i in range(len(part))} for part in (sets.train, sets.validation, sets.test)
    ]
    assert len(groups[0] | groups[1] | groups[2]) == 282 == sum(map(len, groups))
    context = sets.test[0]
    assert (context.adoption, context.hour, context.engine) == (1 / 3, "peak", "combustion")
    assert (context.temperature_c, context.humidity_pct) == (20.0, 46.0)
    assert context.approach is not None


def test_paper_form_trains_and_tests_on_everything():
    sets = in_distribution("salt_lake_city", form="paper")
    assert len(sets.train) == len(sets.validation) == len(sets.test) == 1048


def test_productivity_pairs():
    assert len(OOD_PAIRS) == 90
    sets = productivity()
    assert sets.name == "salt_lake_city -> atlanta"
    assert {sets.train.cities, sets.validation.cities} == {("salt_lake_city",)}
    assert sets.test.cities == ("atlanta",)
    assert sets.test[0].temperature_c == 22.8
    assert productivity("boston", "seattle").test[0].season == "summer"


@pytest.mark.parametrize("test", ["grid", "sample"])
def test_systematicity(test):
    sets = systematicity(test)
    assert len(sets.test) == len(sets.validation) == 128
    boxes = sets.train.product.exclude
    assert len(boxes) == 2
    assert systematicity(test).validation[5] == sets.validation[5]
    hashes = {context.content_hash for context in [*sets.validation, *sets.test]}
    assert len(hashes) == 256
    assert sets.train.sample(np.random.default_rng(0)).content_hash not in hashes
