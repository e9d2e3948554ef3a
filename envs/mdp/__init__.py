"""The MDP, written once: compiled functions over one environment's tables, which know no simulator.

A simulator says who is where; from that, the functions here make what a CV observes, what a vehicle emits, what an
agent is paid and what is counted.

- :mod:`~izoo.envs.mdp.columns`: the columns of the tables.
- :mod:`~izoo.envs.mdp.observation`, :mod:`~izoo.envs.mdp.reward`: what is observed and paid, each column and term
  declared once.
- :mod:`~izoo.envs.mdp.frame`: what an environment emits in a step, as arrays.
- :mod:`~izoo.envs.mdp.slots`, :mod:`~izoo.envs.mdp.displacement`, :mod:`~izoo.envs.mdp.neighbours`,
  :mod:`~izoo.envs.mdp.signals`, :mod:`~izoo.envs.mdp.observation_kernel`, :mod:`~izoo.envs.mdp.reward_kernel`,
  :mod:`~izoo.envs.mdp.metric_sums`, :mod:`~izoo.envs.mdp.commands`: the compiled functions.
- :mod:`~izoo.envs.mdp.state`, :mod:`~izoo.envs.mdp.step`, :mod:`~izoo.envs.mdp.episode`: all of it together, for one
  episode of one environment.
"""
