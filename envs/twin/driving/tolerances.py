"""Distances and speeds of SUMO that tell little from nothing, shared by the rules that use them."""

from __future__ import annotations

EPS = 0.001
"""Smallest gap (m) and speed (m/s) that formulas tell from 0."""
POSITION_EPS = 0.1
"""Distance (m) by which places on a lane are told apart."""
STANDING_MPS = 0.1
"""Who is slower stands."""
VISIBILITY_M = 4.5
"""A driver without priority sees all who may come, and counts as having stopped, this close to a link."""
