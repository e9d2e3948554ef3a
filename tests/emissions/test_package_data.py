"""What izoo carries of ``neuralmoves`` equals the installed package, where there is one."""

import numpy as np
import pytest

from izoo.emissions.classes import CLASSES, DATA
from izoo.emissions.weights import load_weights
from tests.emissions import package_data
from tests.emissions.reference import FUEL_NAMES, SOURCE_NAMES, reference

neuralmoves = pytest.importorskip("neuralmoves")


def test_classes_are_the_models_that_neuralmoves_lists():
    named = {(year, SOURCE_NAMES[source_type], FUEL_NAMES[fuel]) for year, source_type, fuel in CLASSES}
    assert named == set(neuralmoves.list_available_models())


def test_networks_equal_the_package():
    for name, array in package_data.networks().items():
        np.testing.assert_array_equal(getattr(load_weights(), name), array, err_msg=name)


def test_tables_and_licence_equal_the_package():
    for name, text in package_data.tables().items():
        assert (DATA / f"{name}.csv").read_text("utf-8") == text
    assert (DATA / "LICENSE").read_text("utf-8") == package_data.licence()


def test_reference_rates_are_those_of_its_api():
    np.testing.assert_allclose(reference().rate_gps, package_data.rates_gps(), rtol=1e-5)  # float32; machines differ
