"""Driving through a junction on the twin: foes, leaders, right of way, keep clear."""
