"""Losses for agents that come and go."""
