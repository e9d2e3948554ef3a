"""izoo: a TorchRL benchmark for multi-agent contextual reinforcement learning on eco-driving at intersections."""

__version__ = "0.1.0"
