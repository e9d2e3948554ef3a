"""Algorithms and policies as TorchRL modules; they know TensorDict keys, not simulators.

- :mod:`~izoo.algos.learners.registry`: algorithms and drivers by name.
- :mod:`~izoo.algos.learners.base`: keys, the face of an algorithm, network parts.
- :mod:`~izoo.algos.networks.gaussian`: parts of stochastic policies.
- :mod:`~izoo.algos.learners.ppo`: PPO with shared parameters.
- :mod:`~izoo.algos.losses.losses`: TorchRL's losses for agents that come and go, which stand alone; they are made of
  :mod:`~izoo.algos.networks.masking` and :mod:`~izoo.algos.losses.masked_gae`.
- :mod:`~izoo.algos.networks.set_networks`, :mod:`~izoo.algos.learners.set_ppo`, :mod:`~izoo.algos.learners.mappo`:
networks on whole frames, PPO with them, and with a critic over the set of vehicles.
- :mod:`~izoo.algos.learners.graph_ppo`: PPO on the graph of nearby vehicles.
- :mod:`~izoo.algos.actions.action_modes`: what a learned action stands for.
- :mod:`~izoo.algos.networks.censored_normal`, :mod:`~izoo.algos.actions.action_wrappers`,
:mod:`~izoo.algos.actions.residual`: actions whose origin is doing
  nothing; advice to the simulator's driver, and corrections of glide.
- :mod:`~izoo.algos.learners.ddpg`, :mod:`~izoo.algos.learners.td3`: off-policy learners;
:mod:`~izoo.algos.actions.executed_actions`: what came of commands.
- :mod:`~izoo.algos.learners.ppo_config`, :mod:`~izoo.algos.learners.ddpg_config`: hyper-parameters.
- :mod:`~izoo.algos.drivers.scripted`: drivers that do not learn.
"""
