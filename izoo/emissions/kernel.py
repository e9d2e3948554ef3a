"""The MOVES surrogates compiled for one environment: some dozens of vehicles per call, on one core, without torch.

Computes what :class:`izoo.emissions.moves.MovesSurrogate` computes. At this size a batched torch call is all overhead,
whereas the work itself is 4,480 multiply-adds and 128 hyperbolic tangents per vehicle.
"""

from __future__ import annotations

import numpy as np

from izoo.compiling import compiled, local_floats
from izoo.emissions.weights import HIDDEN, KernelWeights, load_weights

__all__ = ["KernelWeights", "emission_rate_kernel", "load_weights"]

_ONE, _TWO, _LIMIT, _EIGHTH = np.float32(1.0), np.float32(2.0), np.float32(9.0), np.float32(0.125)
_N1, _N2 = np.float32(105 / 945), np.float32(1 / 945)
_D1, _D2 = np.float32(420 / 945), np.float32(15 / 945)


@compiled(error_model="numpy")
def fast_tanh(x):  # type: ignore[no-untyped-def]
    """Return tanh of a float32 within 1e-6 relative, in arithmetic that LLVM vectorises.

    The fifth convergent of Lambert's continued fraction, ``y / (1 + y^2 / (3 + y^2 / (5 + ...)))``, at ``y = x / 8``,
    then ``tanh(2y) = 2t / (1 + t^2)`` three times on the fraction ``n / d``, so that only one division is left. Beyond
    9, tanh rounds to 1 in float32.
    """
    x = _LIMIT if x > _LIMIT else x
    x = -_LIMIT if x < -_LIMIT else x
    y = x * _EIGHTH
    q = y * y
    n = y * (_ONE + q * (_N1 + q * _N2))
    d = _ONE + q * (_D1 + q * _D2)
    m = _TWO * n * d
    d = d * d + n * n
    n = _TWO * m * d
    d = d * d + m * m
    m = _TWO * n * d
    d = d * d + n * n
    return m / d


@compiled(error_model="numpy")
def emission_rate_kernel(  # type: ignore[no-untyped-def]
    speed_mps, accel_mps2, grade_pct, moves_class, active, temperature_c, humidity_pct, weights, out_gps
):
    """Write the CO2 rate of ``V`` vehicles in g/s into ``out_gps``; inactive entries get exactly 0, whatever they hold.

    Args:
        speed_mps, accel_mps2, grade_pct: ``[V]`` float32.
        moves_class: ``[V]`` integer, index into :data:`~izoo.emissions.classes.CLASSES`.
        active: ``[V]`` bool or uint8: the slot holds a vehicle with a combustion engine.
        temperature_c, humidity_pct: weather of the call.
        weights: a :class:`KernelWeights`.
        out_gps: ``[V]`` float32, written.

    Raises:
        IndexError: an active vehicle's class is not in the table.
    """
    temperature, humidity = np.float32(temperature_c), np.float32(humidity_pct)
    for v in range(out_gps.shape[0]):
        if not active[v]:
            out_gps[v] = 0.0
            continue
        c = moves_class[v]
        if c < 0 or c >= weights.floor.shape[0]:
            raise IndexError("moves_class of an active vehicle is outside CLASSES")
        motion = speed_mps[v], accel_mps2[v], grade_pct[v]
        out_gps[v] = emission_rate(*motion, c, temperature, humidity, weights)


# Inlined: called, it is handed all arrays of the weights, which costs a third of its time.
@compiled(error_model="numpy", borrows=True, forceinline=True)
def emission_rate(  # type: ignore[no-untyped-def]
    speed_mps, accel_mps2, grade_pct, moves_class, temperature_c, humidity_pct, weights
):
    """Return the CO2 rate of one vehicle in g/s, as :func:`emission_rate_kernel` does; its class is not checked."""
    w1, b1, w2, b2, w3, b3, floor = weights
    temperature, humidity = np.float32(temperature_c), np.float32(humidity_pct)
    speed, accel, grade, c = np.float32(speed_mps), np.float32(accel_mps2), np.float32(grade_pct), moves_class
    first, second = local_floats(HIDDEN), local_floats(HIDDEN)
    for o in range(HIDDEN):
        x = b1[c, o] + temperature * w1[c, 0, o] + humidity * w1[c, 1, o]
        first[o] = fast_tanh(x + speed * w1[c, 2, o] + accel * w1[c, 3, o] + grade * w1[c, 4, o])
    for o in range(HIDDEN):
        second[o] = b2[c, o]
    # Eight inputs per pass: the sums then travel through memory 8 times instead of 64.
    for i in range(0, HIDDEN, 8):
        for o in range(HIDDEN):
            second[o] += (
                first[i] * w2[c, i, o]
                + first[i + 1] * w2[c, i + 1, o]
                + first[i + 2] * w2[c, i + 2, o]
                + first[i + 3] * w2[c, i + 3, o]
                + first[i + 4] * w2[c, i + 4, o]
                + first[i + 5] * w2[c, i + 5, o]
                + first[i + 6] * w2[c, i + 6, o]
                + first[i + 7] * w2[c, i + 7, o]
            )
    for o in range(HIDDEN):
        second[o] = fast_tanh(second[o]) * w3[c, o]
    # Summed pairwise in a fixed order, which vectorises without licence to reorder: with it, the last bit would
    # depend on how the code around this was compiled.
    width = HIDDEN // 2
    while width > 0:
        for o in range(width):
            second[o] += second[o + width]
        width //= 2
    rate = b3[c] + second[0]
    return floor[c] if rate < floor[c] else rate
