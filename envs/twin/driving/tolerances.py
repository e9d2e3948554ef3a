"""SUMO's tolerances of distances and speeds, shared by the rules that use them."""

from __future__ import annotations

EPS = 0.001
"""Smallest gap (m) and speed (m/s) that formulas distinguish from 0."""
POSITION_EPS = 0.1
"""Distance (m) below which positions on a lane are equal."""
STANDING_MPS = 0.1
"""Below this speed a vehicle counts as stopped."""
VISIBILITY_M = 4.5
"""Distance to a link at which a driver without priority sees all approaching vehicles, and counts as having stopped."""
