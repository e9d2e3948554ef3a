"""CO2 of road vehicles, from the MOVES surrogates of ``neuralmoves``.

- :mod:`izoo.emissions.classes`: the vehicle classes (model year, source type, fuel) and their index.
- :mod:`izoo.emissions.moves`: :class:`~izoo.emissions.moves.MovesSurrogate`, a batched torch module.
- :mod:`izoo.emissions.kernel`: the same function compiled for one environment's vehicles.
- :mod:`izoo.emissions.tables`: MOVES default tables. They and the networks are in ``data``, with their licence.

Names are loaded when first used, so that a simulator process can use the kernel without paying for torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from izoo.emissions.moves import MovesSurrogate

__all__ = ["MovesSurrogate"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from izoo.emissions.moves import MovesSurrogate

    return MovesSurrogate
