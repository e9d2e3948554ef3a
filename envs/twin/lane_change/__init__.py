"""Lane changing on the twin: the model LC2013 (Erdmann, "Lane-changing model in SUMO", 2014).

- :mod:`~izoo.envs.twin.lane_change.neighbours`: leaders and followers on the own and the target lane.
- :mod:`~izoo.envs.twin.lane_change.decision`: strategic, cooperative, tactical and keep-right changes.
- :mod:`~izoo.envs.twin.lane_change.cooperation`: speeds advised to the vehicle and its neighbours.
- :mod:`~izoo.envs.twin.lane_change.execution`: the changes of all vehicles in a step.
"""
