"""Memory of the twin's arrays: whole lines of the cache, and working memory that is lent again."""

from __future__ import annotations

import itertools

import numpy as np

from izoo.envs.twin.runtime.compiled import LINE_BYTES
from izoo.envs.twin.runtime.layout import STATE
from izoo.envs.twin.runtime.scratch import Desk, zeros

SHAPES = {"clock": 8, "floats": (5, 16), "link_letter": 3, "ints": (5, 32)}


def test_every_array_begins_with_a_line_and_has_its_own() -> None:
    arrays = zeros(STATE, SHAPES)
    assert {name: array.shape for name, array in arrays.items()} == SHAPES | {"clock": (8,), "link_letter": (3,)}
    assert {name: str(array.dtype) for name, array in arrays.items()} == {
        "clock": "int64", "floats": "float64", "link_letter": "uint8", "ints": "int32"
    }  # fmt: skip
    for array in arrays.values():
        assert array.ctypes.data % LINE_BYTES == 0 and array.flags.c_contiguous and not array.any()
    assert not any(np.shares_memory(*pair) for pair in itertools.combinations(arrays.values(), 2))


def test_a_desk_lends_the_same_memory_and_never_takes_it_away() -> None:
    desk = Desk()
    first, again = (desk.spread(STATE, {"item_ints": (4, 8), "moved": 7}) for _ in range(2))
    first["moved"][:] = 3
    assert again["moved"].tolist() == [3] * 7 and np.shares_memory(first["item_ints"], again["item_ints"])
    larger = desk.spread(STATE, {"item_ints": (400, 8)})
    larger["item_ints"][:] = 5
    assert first["moved"].tolist() == [3] * 7 and not np.shares_memory(first["item_ints"], larger["item_ints"])
    assert not np.shares_memory(Desk().spread(STATE, {"moved": 7})["moved"], again["moved"])
