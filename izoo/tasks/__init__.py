"""Tasks: what to train on, select on and test on, under a name that a paper can cite.

``izoo.tasks.make("busy_lane")`` returns one; ``task=busy_lane`` is the same for commands. A task of one's own is a
:class:`Task` in any module: ``task=my_module:MINE``.
"""

from izoo.tasks.built_in import PAPER, make, names, tasks
from izoo.tasks.task import TEST_SEED, Task, limited

__all__ = ["PAPER", "TEST_SEED", "Task", "limited", "make", "names", "tasks"]
