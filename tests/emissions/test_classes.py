"""The table of vehicle classes."""

import numpy as np
import pytest

from izoo.emissions.classes import CLASSES, moves_class_index
from izoo.errors import IzooError


def test_the_table_is_sorted():
    assert len(CLASSES) == 99 and list(CLASSES) == sorted(CLASSES)


def test_index_is_the_place_in_the_table_for_scalars_and_arrays():
    assert CLASSES[moves_class_index(2015, 21, 1)] == (2015, 21, 1)
    np.testing.assert_array_equal(moves_class_index(*np.array(CLASSES).T), np.arange(99))
    assert moves_class_index(np.array([[2009], [2010]]), 21, np.array([1, 2])).shape == (2, 2)


@pytest.mark.parametrize(
    "triple", [(2008, 21, 1), (2020, 21, 1), (2015, 11, 2), (2015, 22, 1), (2015, 21, 3), (2015, -1, 1)]
)
def test_a_combination_without_a_model_is_refused(triple):
    with pytest.raises(IzooError, match=f"model year {triple[0]}, source type {triple[1]}, fuel {triple[2]};"):
        moves_class_index(*triple)
