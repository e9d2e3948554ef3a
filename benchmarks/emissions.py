"""How fast CO2 is computed: ``python -m izoo.benchmarks.emissions batch=4096``.

The batched module, the compiled kernel of the simulator workers, and the API of the package ``neuralmoves``, on the
same random vehicles of all classes, on one core, in one run.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from izoo.cli.option_command import OptionCommand
from izoo.errors import check_range

ROUNDS = 5
API_CALLS = 200
"""The package's own API loads a network per call, so few calls say enough."""


@dataclass(frozen=True)
class EmissionsConfig:
    """Options of the benchmark of emission rates.

    Attributes:
        batch: vehicles per call.
    """

    batch: int = 4096

    def __post_init__(self) -> None:
        check_range("batch", self.batch, API_CALLS, 10**8)


def random_states(batch: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Return ``batch`` random vehicle states, ``[batch]`` each, in the units of the surrogates."""
    from izoo.emissions.classes import CLASSES

    generator = np.random.default_rng(seed)
    return {
        "speed_mps": generator.uniform(0.0, 20.0, batch).astype(np.float32),
        "accel_mps2": generator.uniform(-4.5, 2.6, batch).astype(np.float32),
        "grade_pct": generator.uniform(-5.0, 5.0, batch).astype(np.float32),
        "moves_class": generator.integers(len(CLASSES), size=batch),
    }


def variants(states: dict[str, np.ndarray]) -> dict[str, tuple[Callable[[], Any], int]]:
    """Return per variant what to time, and how many vehicles one call evaluates."""
    import torch

    from izoo.emissions.kernel import emission_rate_kernel, load_weights
    from izoo.emissions.moves import MovesSurrogate

    batch = len(states["speed_mps"])
    module, weights, out = MovesSurrogate(), load_weights(), np.empty(batch, np.float32)
    tensors = [torch.from_numpy(array) for array in states.values()]
    active = np.ones(batch, np.uint8)

    def batched() -> None:
        with torch.no_grad():
            module(*tensors, 20.0, 46.0)

    def kernel() -> None:
        arrays: list[Any] = [*states.values(), active, 20.0, 46.0, weights, out]
        emission_rate_kernel(*arrays)

    return {
        "MovesSurrogate (batched torch module)": (batched, batch),
        "kernel of the simulator workers": (kernel, batch),
        "neuralmoves API, a call per vehicle": (lambda: _api(states), API_CALLS),
    }


def _api(states: dict[str, np.ndarray]) -> None:
    from neuralmoves import estimate_running_co2
    from neuralmoves.config import FUEL_TYPE_ID_MAP, SOURCE_TYPE_ID_MAP

    from izoo.emissions.classes import CLASSES

    for k in range(API_CALLS):
        year, source_type, fuel = CLASSES[int(states["moves_class"][k])]
        estimate_running_co2(
            float(states["speed_mps"][k]),
            float(states["accel_mps2"][k]),
            float(states["grade_pct"][k]),
            20.0,
            46.0,
            model_year=year,
            source_type=SOURCE_TYPE_ID_MAP[source_type],
            fuel_type=FUEL_TYPE_ID_MAP[fuel],
        )


def measure(call: Callable[[], Any], vehicles: int) -> float:
    """Return vehicle evaluations per second, the median over rounds of at least 0.1 s."""
    call()
    rates = []
    for _ in range(ROUNDS):
        calls, begin = 0, time.perf_counter()
        while time.perf_counter() - begin < 0.1:
            call()
            calls += 1
        rates.append(calls * vehicles / (time.perf_counter() - begin))
    return statistics.median(rates)


def run(config: EmissionsConfig, given: frozenset[str] = frozenset()) -> None:
    """Measure every variant and print the table."""
    print("Loading torch and the surrogates.", flush=True)
    import torch

    from izoo.report.tables import Table

    torch.set_num_threads(1)
    rows = [
        (name, f"{measure(call, vehicles):,.0f}")
        for name, (call, vehicles) in variants(random_states(config.batch)).items()
    ]
    Table.of(f"batch of {config.batch}, one core, medians", ("variant", "vehicles per second"), rows).show()


COMMAND = OptionCommand(
    name="benchmarks.emissions",
    summary="Measure how fast CO2 is computed: batched, compiled, and through the package's own API.",
    examples=("izoo.benchmarks.emissions", "izoo.benchmarks.emissions batch=1024"),
    config="izoo.benchmarks.emissions:EmissionsConfig",
    work="izoo.benchmarks.emissions:run",
)
main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
