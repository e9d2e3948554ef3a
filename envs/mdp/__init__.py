"""The MDP, written once: compiled functions over one environment's tables, independent of the simulator.

A simulator reports the vehicles' positions and speeds; the functions here compute observations, emissions, rewards and
metrics from them.

- :mod:`~izoo.envs.mdp.columns`: the record of a vehicle.
- :mod:`~izoo.envs.mdp.observation`, :mod:`~izoo.envs.mdp.reward`: observation and reward, each column and term
  declared once.
- :mod:`~izoo.envs.mdp.frame`: what an environment emits in a step, as arrays.
- :mod:`~izoo.envs.mdp.slots`, :mod:`~izoo.envs.mdp.displacement`, :mod:`~izoo.envs.mdp.neighbours`,
  :mod:`~izoo.envs.mdp.signals`, :mod:`~izoo.envs.mdp.observation_kernel`, :mod:`~izoo.envs.mdp.reward_kernel`,
  :mod:`~izoo.envs.mdp.metric_sums`, :mod:`~izoo.envs.mdp.commands`: the compiled functions.
- :mod:`~izoo.envs.mdp.state`, :mod:`~izoo.envs.mdp.step`, :mod:`~izoo.envs.mdp.episode`: all of it together, for one
  episode of one environment.
"""
