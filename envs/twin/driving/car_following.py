"""Car following: the intelligent driver model (IDM) in sub-steps, and braking for points and speed limits.

Speeds in m/s, gaps in m, ``driver`` is a record of :attr:`~izoo.envs.twin.runtime.layout.TwinTraffic.drivers`.
Formulas: Treiber, Hennecke, Helbing (2000), discretised as SUMO does it (each found by probing, see the tests).
"""

from __future__ import annotations

import math

import numpy as np

from izoo.envs.tables import compiled, fused
from izoo.envs.twin.driving.tolerances import EPS

SUB_STEP_S = 0.25
FREE_GAP_M = 1e6
COMFORT_DECEL_MPS2 = 1.5


@compiled
def fourth_power(x):  # type: ignore[no-untyped-def]
    """Return ``x ** 4``, in 99.9 % of cases bit for bit like a C library's ``pow``, and faster.

    The rounding error of each product is added again. The last bit matters in lane changing, where a speed difference
    is compared with the difference that was advised.
    """
    square = x * x
    power = square * square
    return power + (fused(square, square, -power) + 2.0 * square * fused(x, x, -square))


@compiled
def idm_speed(driver, gap, speed, leader_speed, wish_mps, min_gap, step_s):  # type: ignore[no-untyped-def]
    """Return the speed (IDM) after one step behind a leader of constant speed.

    ``min_gap`` is the standstill gap, 0 for a point to stop at; ``gap`` excludes it.
    """
    count = max(1, int(step_s / SUB_STEP_S + 0.5))
    gap = gap + min_gap
    part_s = step_s / count
    for _ in range(count):
        ahead = max(0.0, speed * driver.tau + speed * (speed - leader_speed) / driver.two_root_ab) + min_gap
        gap = max(EPS, gap)
        hurry = fourth_power(speed / max(EPS, wish_mps))
        accel = driver.max_accel * (1.0 - hurry - (ahead * ahead) / (gap * gap))
        speed = max(0.0, speed + accel * part_s)
        gap -= max(0.0, (speed - leader_speed) * part_s)
    return speed


@compiled
def secure_gap(driver, speed, leader_speed):  # type: ignore[no-untyped-def]
    """Return the gap (m, beyond the standstill gap) that a driver wants behind a leader."""
    return max(0.0, speed * driver.tau + speed * (speed - leader_speed) / driver.two_root_ab)


@compiled
def follow_speed(driver, gap, speed, leader_speed, wish_mps, step_s):  # type: ignore[no-untyped-def]
    """Return the speed after one step behind a vehicle, ``gap`` (m) being the free road less the standstill gap."""
    return idm_speed(driver, gap, speed, leader_speed, wish_mps, driver.min_gap, step_s)


@compiled
def stop_speed(driver, gap, speed, wish_mps, decel, step_s):  # type: ignore[no-untyped-def]
    """Return the speed after one step towards a point ``gap`` ahead at which to stop."""
    if gap < 0.01:
        return 0.0
    result = idm_speed(driver, gap, speed, 0.0, wish_mps, 0.0, step_s)
    if speed < EPS and result < EPS:
        result = safe_stop_speed(gap, decel, step_s, step_s)
    return min(result, gap / step_s)


@compiled
def free_speed(driver, seen, speed, limit_mps, wish_mps, step_s):  # type: ignore[no-untyped-def]
    """Return the speed after one step on a free road with another limit ``seen`` ahead."""
    if speed <= limit_mps:
        return limit_ahead(driver, seen, unlimited_speed(driver, speed, limit_mps, wish_mps, step_s), limit_mps)
    secure = secure_gap(driver, limit_mps, 0.0)
    return limit_ahead(driver, seen, idm_speed(driver, max(seen, secure), speed, 0.0, wish_mps, 0.0, step_s), limit_mps)


@compiled
def unlimited_speed(driver, speed, limit_mps, wish_mps, step_s):  # type: ignore[no-untyped-def]
    """Return the speed after one step towards a limit that is no lower than ``speed``, at any distance."""
    return idm_speed(driver, FREE_GAP_M, speed, limit_mps, wish_mps, 0.0, step_s)


@compiled
def limit_ahead(driver, seen, speed, limit_mps):  # type: ignore[no-untyped-def]
    """Return ``speed``, capped at a limit that begins within the braking distance (``seen``, m)."""
    return min(speed, limit_mps) if seen < secure_gap(driver, limit_mps, 0.0) else speed


@compiled
def brake_gap(speed, decel, tau_s, step_s):  # type: ignore[no-untyped-def]
    """Return the braking distance (m) in whole steps, after a reaction time of ``tau_s``."""
    loss = decel * step_s
    steps = int(speed / loss)
    return step_s * (steps * speed - loss * steps * (steps + 1) / 2) + speed * tau_s


@compiled
def safe_stop_speed(gap, decel, tau_s, step_s):  # type: ignore[no-untyped-def]
    """Return the highest speed (m/s) from which a vehicle can stop within ``gap`` by braking in whole steps."""
    g = gap - EPS
    if g < 0.0:
        return 0.0
    b = decel * step_s
    root = math.sqrt(step_s * step_s + 4.0 * (step_s * (2.0 * g / b - tau_s) + tau_s * tau_s))
    n = math.floor(0.5 - (tau_s - 0.5 * root) / step_s)
    covered = 0.5 * n * (n - 1) * b * step_s + n * b * tau_s
    return n * b + (g - covered) / (n * step_s + tau_s)


@compiled
def min_speed(driver, speed, step_s):  # type: ignore[no-untyped-def]
    """Return the speed after one step of comfortable braking."""
    decel = max(driver.decel, min(driver.emergency_decel, COMFORT_DECEL_MPS2))
    return max(0.0, speed - decel * step_s)


@compiled
def desired_speed(net, state, v, lane):  # type: ignore[no-untyped-def]
    """Return the speed (m/s) that vehicle ``v`` would have on an empty ``lane``."""
    return min(net.lanes[lane].limit, state.vehicles[v].top_speed)


@compiled
def max_speed(driver, speed, top, step_s):  # type: ignore[no-untyped-def]
    """Return the speed after one step of full acceleration, up to the vehicle's own maximum ``top``."""
    return min(speed + driver.max_accel * step_s, top)


@compiled
def arrival_time_s(driver, way, speed, arrival_speed):  # type: ignore[no-untyped-def]
    """Return the least time (s) for ``way`` (m) with even acceleration to ``arrival_speed``, then constant speed."""
    accel = driver.max_accel if arrival_speed >= speed else -driver.decel
    time_s = (arrival_speed - speed) / accel
    changing = time_s * (arrival_speed + speed) * 0.5
    if way >= changing:
        return time_s + (way - changing) / max(speed, arrival_speed, 0.1)
    return -(speed - math.sqrt(speed * speed + 2.0 * accel * way)) / accel


@compiled
def accelerated_speed(way, speed, accel, top):  # type: ignore[no-untyped-def]
    """Return the speed (m/s) after ``way`` m of constant acceleration, up to the vehicle's own maximum ``top``."""
    return min(top, np.sqrt(2.0 * way * accel + speed * speed))


@compiled
def braked_speed(driver, way, speed, arrival_speed, step_s):  # type: ignore[no-untyped-def]
    """Return the speed (m/s) after ``way`` m if the driver brakes after ``tau``; 0 if it can stop before."""
    if way >= brake_gap(speed, driver.decel, driver.tau, step_s):
        return 0.0
    braking_m = way - speed * driver.tau
    return min(arrival_speed, math.sqrt(max(0.0, speed * speed - 2.0 * driver.decel * max(0.0, braking_m))))
