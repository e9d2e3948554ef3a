"""Trained policies that ship with izoo: their weights, the options that they were trained with, and their cards.

``zoo.load(NAME)`` returns one; ``policy=zoo:NAME`` is the same for commands. ``python -m izoo.zoo list``
shows them all. The policy of a run becomes such a file with ``python -m izoo.zoo export``, and is then meant by its
path.
"""

from izoo.zoo.catalog import card, named, names
from izoo.zoo.trained import TrainedPolicy, check_fits, full_episodes, load, read, write

__all__ = ["TrainedPolicy", "card", "check_fits", "full_episodes", "load", "named", "names", "read", "write"]
