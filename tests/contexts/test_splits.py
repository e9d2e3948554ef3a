import hashlib

import pytest

from izoo.contexts.cities.rebuilt import CITIES, SIZES
from izoo.contexts.splits import SPLITS, city_split, split_names
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
