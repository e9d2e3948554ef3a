"""How fast CO2 is computed: ``python -m izoo.benchmarks.emissions [--batch N]``.

The batched module, the compiled kernel of the simulator workers, a loop over vehicle classes, and the API of the
package ``neuralmoves``, on the same random vehicles of all classes, on one core, in one run.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from izoo.console import exit_code

ROUNDS = 5
API_CALLS = 200
"""The package's own API loads a network per call, so few calls say enough."""


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
        "loop over classes": (lambda: _class_loop(tensors, weights), batch),
        "neuralmoves API, a call per vehicle": (lambda: _api(states), API_CALLS),
    }


def _class_loop(tensors: list[Any], weights: Any) -> Any:
    """Evaluate class by class, each as one small network on its own vehicles."""
    import torch

    speed, accel, grade, moves_class = tensors
    inputs = torch.stack([torch.full_like(speed, 20.0), torch.full_like(speed, 46.0), speed, accel, grade], dim=-1)
    out = torch.empty_like(speed)
    w1, b1, w2, b2, w3, b3, floor = (_as_tensor(array) for array in weights)
    for c in range(len(floor)):
        chosen = torch.nonzero(moves_class == c).view(-1)
        hidden = torch.tanh(inputs[chosen] @ w1[c] + b1[c])
        hidden = torch.tanh(hidden @ w2[c] + b2[c])
        out[chosen] = torch.maximum(hidden @ w3[c] + b3[c], floor[c])
    return out


def _as_tensor(array: np.ndarray) -> Any:
    import torch

    return torch.from_numpy(np.array(array))


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


def main(argv: list[str] | None = None) -> int:
    """Run the benchmark; returns the exit code."""
    parser = argparse.ArgumentParser("python -m izoo.benchmarks.emissions", description=__doc__.split("\n\n")[0])
    parser.add_argument("--batch", type=int, default=4096, help="vehicles per call (default 4096)")
    options = parser.parse_args(argv)
    if options.batch < API_CALLS:
        parser.error(f"--batch is {options.batch}; it must be {API_CALLS} or more")
    print("izoo emissions: loading torch and the surrogates", file=sys.stderr, flush=True)
    import torch
    from rich.console import Console
    from rich.table import Table

    torch.set_num_threads(1)
    table = Table(title=f"batch of {options.batch}, one core, medians")
    table.add_column("variant")
    table.add_column("vehicles per second", justify="right")
    for name, (call, vehicles) in variants(random_states(options.batch)).items():
        table.add_row(name, f"{measure(call, vehicles):,.0f}")
    Console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(exit_code("benchmarks.emissions", main))
