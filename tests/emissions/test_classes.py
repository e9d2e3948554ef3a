"""The table of vehicle classes."""

import neuralmoves
import numpy as np
import pytest

from izoo.emissions.classes import CLASSES, moves_class_index
from izoo.emissions.tables import moves_file, read_default_table
from izoo.errors import IzooError
from tests.emissions.reference import FUEL_NAMES, SOURCE_NAMES


def test_the_table_holds_the_models_that_neuralmoves_lists():
    named = {(year, SOURCE_NAMES[source_type], FUEL_NAMES[fuel]) for year, source_type, fuel in CLASSES}
    assert named == set(neuralmoves.list_available_models())
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


def test_tables_are_found_and_filtered():
    rows = read_default_table(
        "source_type_population", lambda row: row["yearID"] == "2019" and row["sourceTypeID"] == "21"
    )
    assert [row["sourceTypePopulation"] for row in rows] == ["108547710"]
    with pytest.raises(IzooError, match="neuralmoves has no file"):
        moves_file("defaults", "nothing.csv")
