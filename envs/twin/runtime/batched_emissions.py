"""CO2 of many environments' vehicles, class by class: in one call of the torch surrogate, or compiled.

Vehicles that emit something else than in the step before are counted by class while they drive, and their inputs then
written straight to where their class is worked on: for torch into the tiles in which
:meth:`~izoo.emissions.moves.MovesSurrogate.tiled_rates` takes them. Nothing is sorted, and no tensor but those of the
layers is made. The weights of a class are 18 kB, and those of all classes more than what is close to the processor.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from izoo.emissions.classes import CLASSES
from izoo.emissions.kernel import emission_rate
from izoo.emissions.weights import INPUTS, KernelWeights, load_weights
from izoo.envs.mdp.state import open_world
from izoo.envs.tables import compiled
from izoo.envs.twin.runtime.prefetch import ADDRESSES, WORLD_AT

if TYPE_CHECKING:
    from izoo.emissions.moves import MovesSurrogate

GROUP = 16
"""So many environments are played side by side with the compiled surrogate: enough to use the weights of a class for
several vehicles, and so few that what a step of them touches stays in the cache."""


class Rows(NamedTuple):
    """Working memory of the compiled surrogate.

    Attributes:
        chosen: ``[GROUP + 1, 4]`` int64, addresses of the environments that are played.
        by_class: ``[C]`` int64, how many vehicles of each class emit something new.
        place: ``[C]`` int64, the row of the next of them.
        moves_class: ``[n]`` int64, class of each row.
        inputs: ``[n, 5]`` float32, one row per vehicle.
        rates_gps: ``[n]`` float32.
        surrogate: what computes them.
    """

    chosen: np.ndarray
    by_class: np.ndarray
    place: np.ndarray
    moves_class: np.ndarray
    inputs: np.ndarray
    rates_gps: np.ndarray
    surrogate: KernelWeights


class Emitter:
    """Computes the CO2 of a share of the environments; each thread has one.

    Args:
        module: the surrogates; computes where its weights are.

    Attributes:
        by_class: ``[C]`` int64, how many vehicles of each class emit something new; driving fills it.
    """

    def __init__(self, module: MovesSurrogate) -> None:
        self._module, self._device = module, module.w1.device
        self.by_class = np.zeros(len(CLASSES), np.int64)
        self._place = np.zeros(len(CLASSES), np.int64)
        self._inputs = np.zeros((0, INPUTS), np.float32)
        self._tile_class = np.zeros(0, np.int64)
        self._rates_gps = np.zeros(0, np.float32)
        self._chosen = np.zeros((GROUP + 1, ADDRESSES), np.int64)

    def rows(self, vehicles: int) -> Rows:
        """Return working memory for the compiled surrogate, of so many vehicles; what is not used takes no memory."""
        if vehicles > len(self._rates_gps):
            self._inputs, self._rates_gps = np.zeros((vehicles, INPUTS), np.float32), np.zeros(vehicles, np.float32)
            self._tile_class = np.zeros(vehicles, np.int64)
        memory = self._chosen, self.by_class, self._place, self._tile_class, self._inputs, self._rates_gps
        return Rows(*memory, load_weights())

    def emit(self, addresses: np.ndarray) -> None:
        """Write the CO2 of the environments at ``addresses`` into their tables."""
        import torch  # processes that prepare episodes do without

        from izoo.emissions.moves import tile_rows

        count = int(self.by_class.sum())
        if count == 0:
            return
        tile = tile_rows(count)
        most = count // tile + len(CLASSES)
        if most * tile > len(self._inputs):
            self._inputs = np.zeros((2 * most * tile, INPUTS), np.float32)
        if most > len(self._tile_class):
            self._tile_class = np.zeros(2 * most, np.int64)
        tiles = lay_out(self.by_class, tile, self._place, self._tile_class)
        gather(addresses, self._place, self._inputs)
        with torch.inference_mode():
            inputs = torch.from_numpy(self._inputs[: tiles * tile]).view(tiles, tile, INPUTS).to(self._device)
            tile_class = torch.from_numpy(self._tile_class[:tiles]).to(self._device)
            rates = self._module.tiled_rates(inputs, tile_class).view(-1).cpu().numpy()
        lay_out(self.by_class, tile, self._place, self._tile_class)
        scatter(addresses, self._place, rates)


@compiled
def lay_out(by_class, tile, place, tile_class):  # type: ignore[no-untyped-def]
    """Give every class as many tiles of ``tile`` rows as it needs; return how many tiles there are.

    Args:
        by_class: ``[C]`` vehicles per class.
        place: ``[C]`` output, first row of each class.
        tile_class: output, class of each tile.
    """
    tiles = 0
    for c in range(by_class.shape[0]):
        place[c] = tiles * tile
        for _ in range((by_class[c] + tile - 1) // tile):
            tile_class[tiles] = c
            tiles += 1
    return tiles


@compiled
def burns_anew(vehicle):  # type: ignore[no-untyped-def]
    """Whether a vehicle emits something else than in the step before."""
    return not vehicle.steady and not vehicle.electric


@compiled
def count_classes(world, by_class):  # type: ignore[no-untyped-def]
    """Add the vehicles that emit something new to ``by_class``."""
    tables = world.tables
    for j in range(tables.cursor.members):
        vehicle = tables.vehicles[tables.members[j]]
        if burns_anew(vehicle):
            by_class[vehicle.moves_class] += 1


@compiled
def emit_group(addresses, rows):  # type: ignore[no-untyped-def]
    """Write the CO2 of some environments into their tables, as the compiled surrogate computes it.

    Args:
        addresses: as for :func:`~izoo.envs.twin.runtime.batch_step.drive_all`.
        rows: a :class:`Rows` whose ``by_class`` is filled.
    """
    _, by_class, place, moves_class, inputs, rates_gps, surrogate = rows
    count = lay_out(by_class, 1, place, moves_class)
    gather(addresses, place, inputs)
    for at in range(count):
        x = inputs[at]
        rates_gps[at] = emission_rate(x[2], x[3], x[4], moves_class[at], x[0], x[1], surrogate)
    lay_out(by_class, 1, place, moves_class)
    scatter(addresses, place, rates_gps)


@compiled
def gather(addresses, place, inputs):  # type: ignore[no-untyped-def]
    """Write the inputs of all vehicles that emit something new to the next rows of their classes.

    Args:
        addresses: as for :func:`~izoo.envs.twin.runtime.batch_step.drive_all`.
        place: ``[C]`` first row of each class; counts on.
        inputs: ``[n, 5]`` float32 output.
    """
    for k in range(addresses.shape[0]):
        _gather(open_world(addresses[k, WORLD_AT]), place, inputs)


@compiled
def _gather(world, place, inputs):  # type: ignore[no-untyped-def]
    tables, temperature_c, humidity_pct = world.tables, world.rules.temperature_c, world.rules.humidity_pct
    for j in range(tables.cursor.members):
        vehicle = tables.vehicles[tables.members[j]]
        if burns_anew(vehicle):
            at = place[vehicle.moves_class]
            place[vehicle.moves_class] += 1
            inputs[at, 0], inputs[at, 1] = temperature_c, humidity_pct
            inputs[at, 2], inputs[at, 3] = vehicle.speed_mps, vehicle.accel_mps2
            inputs[at, 4] = vehicle.grade_pct


@compiled
def scatter(addresses, place, rates_gps):  # type: ignore[no-untyped-def]
    """Write CO2 in g of the step, from rates in the rows that :func:`gather` filled."""
    for k in range(addresses.shape[0]):
        _scatter(open_world(addresses[k, WORLD_AT]), place, rates_gps)


@compiled
def _scatter(world, place, rates_gps):  # type: ignore[no-untyped-def]
    tables, step_s = world.tables, world.rules.step_s
    for j in range(tables.cursor.members):
        vehicle = tables.vehicles[tables.members[j]]
        if burns_anew(vehicle):
            at = place[vehicle.moves_class]
            place[vehicle.moves_class] += 1
            vehicle.emission_g = rates_gps[at] * step_s
