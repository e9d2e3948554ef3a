"""CO2 of road vehicles, from the MOVES surrogates of ``neuralmoves``.

- :mod:`izoo.emissions.classes`: the vehicle classes (model year, source type, fuel) and their index, and MOVES default
  tables. They and the networks are in ``data``, with their licence.
- :mod:`izoo.emissions.moves`: :class:`~izoo.emissions.moves.MovesSurrogate`, a batched torch module.
- :mod:`izoo.emissions.kernel`: the same function compiled for one environment's vehicles.
"""
