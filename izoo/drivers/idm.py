"""How the intelligent driver model (IDM) changes a speed in one step, in JAX, for any number of drivers and steps.

The same arithmetic as the simulator's, which takes a step in parts of at most a quarter of a second or so: a population
calibrated with it drives in the simulator as it did on the street.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

INNER_STEP_S = 0.25
"""SUMO's default: a step of its IDM is made of this long parts, their number rounded."""
EXPONENT = 4.0
SMALLEST_GAP_M = 0.01


def next_speed(log_parameters: Array, speed: Array, gap: Array, leader_speed: Array, step_s: float) -> Array:
    """Return the speed after one step behind a leader that keeps its own.

    The intelligent driver model (Treiber, Hennecke and Helbing, Physical Review E 62, 2000):

    ``a = alpha (1 - (v / v0)^4 - (s* / s)^2)`` with ``s* = s0 + max(0, v T + v dv / (2 sqrt(alpha beta)))``; within the
    step the gap closes, but does not open.

    Args:
        log_parameters: ``[..., 5]`` natural logarithms of v0, s0, T, alpha and beta; broadcasts against the others.
        speed, gap, leader_speed: ``[...]`` in m/s and m.
        step_s: length of the step.

    Returns:
        ``[...]`` in m/s, never below 0.
    """
    desired_speed, standstill_gap, headway, alpha, beta = jnp.moveaxis(jnp.exp(log_parameters), -1, 0)
    braking = 2.0 * jnp.sqrt(alpha * beta)
    parts = inner_steps(step_s)
    part_s = step_s / parts
    for _ in range(parts):
        wanted = standstill_gap + jnp.maximum(0.0, speed * (headway + (speed - leader_speed) / braking))
        ratio = wanted / jnp.maximum(gap, SMALLEST_GAP_M)
        acceleration = alpha * (1.0 - (speed / desired_speed) ** EXPONENT - ratio**2)
        speed = jnp.maximum(0.0, speed + acceleration * part_s)
        gap = gap - jnp.maximum(0.0, (speed - leader_speed) * part_s)
    return speed


def inner_steps(step_s: float) -> int:
    """Return in how many parts the simulator takes a step."""
    return max(1, int(step_s / INNER_STEP_S + 0.5))
