"""Protocols that compare algorithms, and how fast environments run."""
