"""What is held out for validation and tests. Nothing on this page may ever change.

Intersections are ordered by a hash of a constant and their name, so a split depends on neither NumPy nor the platform;
the first tenth is the test set, the second the validation set, the rest the training set.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence
from typing import Literal

from izoo.contexts.cities.rebuilt import SIZES, city_name
from izoo.errors import IzooError, check_choice

SPLITS = ("train", "validation", "test")
SplitName = Literal["train", "validation", "test", "all"]
SPLIT_KEY = "izoo-split-1"
"""Published constant."""
HELD_OUT_SHARE = 0.1
"""Share of the intersections in the test set, and in the validation set."""


def split_names(names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Split any set of intersections by name, 80/10/10.

    Args:
        names: intersection names, unique; their order does not matter.

    Returns:
        per split its names, in the order given. With fewer than five names all of them are for training.
    """
    if len(set(names)) != len(names):
        raise IzooError("intersection names repeat; a split needs one name per intersection.")
    ranked = sorted(names, key=lambda name: hashlib.sha256(f"{SPLIT_KEY}/{name}".encode()).digest())
    held_out = int(len(names) * HELD_OUT_SHARE + 0.5)
    chosen = dict.fromkeys(ranked[:held_out], "test")
    chosen.update(dict.fromkeys(ranked[held_out : 2 * held_out], "validation"))
    return {split: tuple(name for name in names if chosen.get(name, "train") == split) for split in SPLITS}


@functools.cache
def city_split(city: str, split: SplitName = "all") -> tuple[int, ...]:
    """Return the numbers of a city's intersections that belong to a split, ascending; ``all`` gives every one."""
    city = city_name(city)
    check_choice("split", split, (*SPLITS, "all"))
    if split == "all":
        return tuple(range(SIZES[city]))
    names = split_names([f"{city}/{index}" for index in range(SIZES[city])])[split]
    return tuple(int(name.rpartition("/")[2]) for name in names)
