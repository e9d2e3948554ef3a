"""Losses for agents that come and go, as TorchRL modules that stand alone.

They are subclasses of TorchRL's own and take TensorDicts ``[*B]`` whose agents have a dimension more, ``[*B, A, ...]``,
and a mask ``[*B, A]`` of the slots that hold an agent. Valid agent-steps are flattened to rows inside, so that losses,
statistics, normalisation and logs see no padding, whatever it holds; a batch without a mask is taken for rows already.
Where a batch holds ``("agents", "decides")`` as well, only the agents that decide are rows
(:mod:`izoo.algos.learners.decisions`).

Networks are TensorDictModules. One that also reads the mask works on whole frames (a *frame* is one
environment at one time, its agents a set): it gets all valid agents of each frame, in any number of slots.
"""

from izoo.algos.losses.ddpg import MaskedDDPGLoss
from izoo.algos.losses.ppo import MaskedGraphPPOLoss, MaskedMAPPOLoss, MaskedPPOLoss
from izoo.algos.losses.td3 import MaskedTD3Loss

__all__ = ["MaskedDDPGLoss", "MaskedGraphPPOLoss", "MaskedMAPPOLoss", "MaskedPPOLoss", "MaskedTD3Loss"]
