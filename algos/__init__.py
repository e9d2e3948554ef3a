"""Algorithms and policies as TorchRL modules; they know TensorDict keys, not simulators.

- :mod:`~izoo.algos.registry`: algorithms and drivers by name.
- :mod:`~izoo.algos.base`: keys, the face of an algorithm, network parts.
- :mod:`~izoo.algos.gaussian`: parts of stochastic policies.
- :mod:`~izoo.algos.ppo`: PPO with shared parameters.
- :mod:`~izoo.algos.losses`: TorchRL's losses for agents that come and go, which stand alone; they are made of
  :mod:`~izoo.algos.masked_rows` and :mod:`~izoo.algos.masked_gae`.
- :mod:`~izoo.algos.sets`, :mod:`~izoo.algos.set_ppo`, :mod:`~izoo.algos.mappo`: networks on whole frames, PPO with
  them, and with a critic over the set of vehicles.
- :mod:`~izoo.algos.gcrl`: PPO on the graph of nearby vehicles.
- :mod:`~izoo.algos.action`: what a learned action stands for.
- :mod:`~izoo.algos.resting`, :mod:`~izoo.algos.advice`, :mod:`~izoo.algos.residual`: actions whose origin is doing
  nothing; advice to the simulator's driver, and corrections of glide.
- :mod:`~izoo.algos.ddpg`, :mod:`~izoo.algos.td3`: off-policy learners; :mod:`~izoo.algos.applied`: what came of
  commands.
- :mod:`~izoo.algos.ppo_config`, :mod:`~izoo.algos.ddpg_config`: hyper-parameters.
- :mod:`~izoo.algos.scripted`: drivers that do not learn.
"""
