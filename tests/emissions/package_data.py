"""What izoo carries of the package ``neuralmoves``; ``python -m tests.emissions.package_data`` writes it anew.

That needs ``pip install --no-deps neuralmoves==0.4.0``: the package asks for numpy below 2 but runs with any.
"""

import importlib.metadata
import importlib.util
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from izoo.contexts.cities.weather import CITY_COUNTIES
from izoo.emissions.classes import CLASSES, DATA, FUELS
from izoo.traffic.fleet import CALENDAR_YEAR, FLEET_TYPES, OLDEST_AGE
from tests.emissions.reference import FUEL_NAMES, RATES, SOURCE_NAMES, states


def installed(*parts: str) -> Path:
    """Return a file of the installed package, without importing it."""
    found = importlib.util.find_spec("neuralmoves")
    assert found is not None and found.origin is not None
    return Path(found.origin).parent.joinpath(*parts)


def networks() -> dict[str, np.ndarray]:
    """Return the arrays of :class:`izoo.emissions.weights.KernelWeights`."""
    nets = [torch.load(installed("NN_3", f"NN_model_{y}_{s}_{f}.pt"), weights_only=True) for y, s, f in CLASSES]
    idling = pd.read_csv(installed("idling_emissions.csv")).drop_duplicates(["modelYear", "sourceTypeID", "fuelTypeID"])
    rates = idling.set_index(["modelYear", "sourceTypeID", "fuelTypeID"])["emission_per_second_MOVES"]

    def stack(name: str) -> np.ndarray:
        return np.stack([net[name].numpy().astype(np.float32) for net in nets])

    arrays = {
        "w1": stack("layer1.weight").transpose(0, 2, 1),
        "b1": stack("layer1.bias"),
        "w2": stack("layer2.weight").transpose(0, 2, 1),
        "b2": stack("layer2.bias"),
        "w3": stack("layer3.weight")[:, 0],
        "b3": stack("layer3.bias")[:, 0],
        "floor": np.array([rates[key] for key in CLASSES], dtype=np.float32),
    }
    return {name: np.ascontiguousarray(array) for name, array in arrays.items()}


def tables() -> dict[str, str]:
    """Return the tables as CSV, with the rows that izoo reads and the values as the package spells them."""

    def table(name: str, **kept: object) -> str:
        rows = pd.read_csv(installed("defaults", f"{name}.csv"), dtype=str)
        for column, values in kept.items():
            rows = rows[rows[column].isin([str(value) for value in values])]  # type: ignore[attr-defined]
        return rows.to_csv(index=False, lineterminator="\n")

    year = range(CALENDAR_YEAR, CALENDAR_YEAR + 1)
    return {
        "age_distribution": table("age_distribution", yearID=year, sourceTypeID=FLEET_TYPES),
        "county_meteorology": table("county_meteorology", countyID=CITY_COUNTIES.values()),
        "sample_vehicle_population": table(
            "sample_vehicle_population",
            sourceTypeID=FLEET_TYPES,
            modelYearID=range(CALENDAR_YEAR - OLDEST_AGE, CALENDAR_YEAR + 1),
            fuelTypeID=FUELS,
        ),
        "source_type_population": table("source_type_population", yearID=year, sourceTypeID=FLEET_TYPES),
    }


def licence() -> str:
    """Return the text of the package's licence."""
    files = importlib.metadata.files("neuralmoves") or []
    (path,) = [file for file in files if file.name == "LICENSE"]
    return path.read_text("utf-8")


def rates_gps() -> np.ndarray:
    """Return the rates of :func:`tests.emissions.reference.states` by the package's own API, float32."""
    import neuralmoves

    speed, accel, grade, temperature, humidity = states()
    rates = [
        neuralmoves.estimate_emissions_timeseries(
            speed[c],
            accel[c],
            grade[c],
            temperature[c, 0],
            humidity[c, 0],
            model_year=year,
            source_type=SOURCE_NAMES[source_type],
            fuel_type=FUEL_NAMES[fuel],
        )
        for c, (year, source_type, fuel) in enumerate(CLASSES)
    ]
    return np.array(rates, np.float32)


if __name__ == "__main__":
    np.savez(DATA / "networks.npz", **networks())
    for name, text in tables().items():
        (DATA / f"{name}.csv").write_text(text, "utf-8")
    (DATA / "LICENSE").write_text(licence(), "utf-8")
    np.save(RATES, rates_gps())
