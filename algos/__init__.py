"""Algorithms and policies as TorchRL modules; they know TensorDict keys, not simulators.

- :mod:`~izoo.algos.base`: keys, the face of an algorithm, network parts.
- :mod:`~izoo.algos.ppo`: PPO with shared parameters.
- :mod:`~izoo.algos.scripted`: drivers that do not learn.
"""
