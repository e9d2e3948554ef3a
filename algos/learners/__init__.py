"""Algorithms, each with its hyper-parameters."""
