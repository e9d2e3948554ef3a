"""The MOVES surrogates as one torch module, batched over vehicles of all classes."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from izoo.emissions.classes import CLASSES, moves_class_index
from izoo.emissions.weights import INPUTS, KernelWeights, load_weights
from izoo.errors import IzooError

__all__ = ["CLASSES", "MovesSurrogate", "moves_class_index"]

_CPU_CHUNK_ROWS = 4096
_DEVICE_CHUNK_ROWS = 1 << 20


class MovesSurrogate(nn.Module):
    """CO2 rate of vehicles in g/s: 99 networks 5-64-64-1, one per class, floored at the idling rate.

    Vehicles are sorted by class and laid into tiles of equal size, each of one class, so that every layer is one
    batched matrix product. tanh is written as ``2 sigmoid(2x) - 1`` with the constants folded into the weights, as
    sigmoid is several times faster in torch on a CPU.

    Args:
        weights: the networks; by default those of ``neuralmoves`` 0.4.
    """

    w1: Tensor
    b1: Tensor
    w2: Tensor
    b2: Tensor
    w3: Tensor
    b3: Tensor
    floor: Tensor

    def __init__(self, weights: KernelWeights | None = None) -> None:
        super().__init__()
        for name, array in _fold_tanh(load_weights() if weights is None else weights)._asdict().items():
            self.register_buffer(name, torch.from_numpy(array.copy()), persistent=False)

    def forward(
        self,
        speed_mps: Tensor,
        accel_mps2: Tensor,
        grade_pct: Tensor,
        moves_class: Tensor,
        temperature_c: Tensor | float,
        humidity_pct: Tensor | float,
        mask: Tensor | None = None,
        electric: Tensor | None = None,
    ) -> Tensor:
        """Return the CO2 rate in g/s, of the arguments' broadcast shape ``[*B, V]``, float32.

        Entries that are masked out or electric are exactly 0, whatever the other arguments hold there.

        Args:
            speed_mps, accel_mps2: speed and acceleration.
            grade_pct: 100 times rise over run along the driving direction.
            moves_class: integer, index into :data:`~izoo.emissions.classes.CLASSES`.
            temperature_c, humidity_pct: weather, a number or a tensor.
            mask: bool, where there is a vehicle; default everywhere.
            electric: bool, where the vehicle burns no fuel; default nowhere.

        Raises:
            IzooError: a vehicle that counts has a class outside the table.
        """
        inputs = [
            torch.as_tensor(value, dtype=torch.float32, device=self.w1.device)
            for value in (temperature_c, humidity_pct, speed_mps, accel_mps2, grade_pct)
        ]
        shape = torch.broadcast_shapes(
            moves_class.shape, *(x.shape for x in (*inputs, mask, electric) if x is not None)
        )
        features = torch.stack([value.expand(shape) for value in inputs], dim=-1).reshape(-1, INPUTS)
        classes = moves_class.expand(shape).reshape(-1)
        burning = _burning(mask, electric)
        if burning is None:
            return self._rates(features, classes).reshape(shape)
        burning = burning.expand(shape).reshape(-1)
        rows = burning.nonzero()[:, 0]
        rates = self._rates(features.index_select(0, rows), classes.index_select(0, rows))
        return torch.zeros(len(classes), device=rates.device).index_put((rows,), rates).reshape(shape)

    def _rates(self, features: Tensor, classes: Tensor) -> Tensor:
        """Return g/s ``[N]`` of ``features [N, 5]`` and ``classes [N]``, whose range is checked."""
        if len(classes) == 0:
            return features.new_zeros(0)
        low, high = (int(bound) for bound in torch.aminmax(classes))
        if low < 0 or high >= len(CLASSES):
            raise IzooError(
                f"MOVES classes of vehicles run from {low} to {high}; they must lie in [0, {len(CLASSES) - 1}]: "
                "use moves_class_index, and mask empty slots."
            )
        count, tile = len(classes), tile_rows(len(classes))
        ordered, order = torch.sort(classes)
        table = torch.arange(len(CLASSES), device=classes.device)
        begin = torch.searchsorted(ordered, table)
        members = torch.searchsorted(ordered, table, right=True) - begin
        tiles = (members + tile - 1) // tile
        tiles_end = tiles.cumsum(0)
        total = int(tiles_end[-1])
        tile_class = torch.searchsorted(tiles_end, torch.arange(total, device=classes.device), right=True)
        shift = (tiles_end - tiles) * tile - begin
        slot = torch.arange(count, device=classes.device) + shift.index_select(0, ordered)
        padded = features.new_zeros(total * tile, INPUTS).index_copy(0, slot, features.index_select(0, order))
        tiled = self.tiled_rates(padded.view(total, tile, INPUTS), tile_class).reshape(-1)
        rates = tiled.index_select(0, slot)
        return torch.zeros_like(rates).index_copy(0, order, rates)

    def tiled_rates(self, tiled: Tensor, tile_class: Tensor) -> Tensor:
        """Return g/s ``[M, T]`` of the inputs ``tiled [M, T, 5]`` of vehicles already laid into tiles.

        Args:
            tiled: temperature (C), humidity (%), speed (m/s), acceleration (m/s^2) and grade (%), float32.
            tile_class: ``[M]`` the class of each tile, not checked. Rows without a vehicle may hold any numbers.
        """
        rows = _CPU_CHUNK_ROWS if tiled.device.type == "cpu" else _DEVICE_CHUNK_ROWS
        # In chunks that stay in the processor's cache.
        step = max(1, rows // tiled.shape[1])
        parts = []
        for start in range(0, len(tiled), step):
            chosen = tile_class[start : start + step]
            weights = [buffer.index_select(0, chosen) for buffer in (self.w1, self.b1, self.w2, self.b2, self.w3)]
            w1, b1, w2, b2, w3 = weights
            hidden = torch.baddbmm(b1[:, None], tiled[start : start + step], w1).sigmoid_()
            hidden = torch.baddbmm(b2[:, None], hidden, w2).sigmoid_()
            # Faster on a CPU than a matrix product with a single column.
            rate = hidden.mul(w3[:, None]).sum(dim=-1) + self.b3.index_select(0, chosen)[:, None]
            parts.append(torch.maximum(rate, self.floor.index_select(0, chosen)[:, None]))
        return parts[0] if len(parts) == 1 else torch.cat(parts)


def tile_rows(count: int) -> int:
    """Return the rows of a tile for ``count`` vehicles; each tile costs a copy of its class's weights.

    Measured with the classes of sampled traffic, of which two make up almost half: larger tiles stay half empty.
    """
    for rows, most in ((4, 2), (8, 6), (16, 40), (32, 160)):
        if count <= most * len(CLASSES):
            return rows
    return 128


def _burning(mask: Tensor | None, electric: Tensor | None) -> Tensor | None:
    """Return where CO2 is emitted, or ``None`` for everywhere."""
    if electric is None:
        return mask
    return ~electric if mask is None else mask & ~electric


def _fold_tanh(weights: KernelWeights) -> KernelWeights:
    """Return weights of the same function with ``sigmoid`` in place of ``tanh``, by ``tanh x = 2 sigmoid(2x) - 1``."""
    w1, b1, w2, b2, w3, b3, floor = (array.astype(np.float64) for array in weights)
    folded = (2 * w1, 2 * b1, 4 * w2, 2 * (b2 - w2.sum(axis=1)), 2 * w3, b3 - w3.sum(axis=1), floor)
    return KernelWeights(*(array.astype(np.float32) for array in folded))
