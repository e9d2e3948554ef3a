"""Trained policies that ship with izoo: their weights, the options that they were trained with, and their cards.

``zoo.load(NAME)`` returns one; ``policy=zoo:NAME`` is the same for commands. ``python -m izoo.zoo list``
shows them all.
"""

from izoo.zoo.shelf import PREFIX, card, check_name, named, names
from izoo.zoo.trained import TrainedPolicy, full_episodes, load, read, write

__all__ = ["PREFIX", "TrainedPolicy", "card", "check_name", "full_episodes", "load", "named", "names", "read", "write"]
