"""Algorithms and policies as TorchRL modules; they know TensorDict keys, not simulators.

- :mod:`~izoo.algos.learners`: algorithms, each with its hyper-parameters; :mod:`~izoo.algos.learners.registry` names
  them, and :mod:`~izoo.algos.learners.base` is what they have in common.
- :mod:`~izoo.algos.losses`: TorchRL's losses for agents that come and go, which can be used alone.
- :mod:`~izoo.algos.networks`: distributions, networks on sets of agents, compiled policies.
- :mod:`~izoo.algos.actions`: action modes, what a learned action means.
- :mod:`~izoo.algos.drivers`: drivers that do not learn; :mod:`~izoo.algos.drivers.by_name` builds them.
"""
