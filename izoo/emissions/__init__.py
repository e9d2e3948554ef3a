"""CO2 of road vehicles, from the MOVES surrogates of the package ``neuralmoves``.

- :mod:`izoo.emissions.classes`: the vehicle classes (model year, source type, fuel) and their index.
- :mod:`izoo.emissions.moves`: :class:`~izoo.emissions.moves.MovesSurrogate`, a batched torch module.
- :mod:`izoo.emissions.kernel`: the same function compiled for one environment's vehicles.
- :mod:`izoo.emissions.tables`: the data files that ``neuralmoves`` brings along.
"""
