"""Sine, cosine and arc tangent from basic arithmetic, to one or two units in the last place.

They are for code that runs on SIMD lanes, because the C library computes one value at a time.  Sine
and cosine: reduction to [-pi/4, pi/4] with a split pi/2 (Cody and Waite), exact for angles up to
about 1e5 rad, and the polynomials of FDLIBM's ``__kernel_sin`` and ``__kernel_cos``.  Arc tangent:
Cephes' ``atan``.
"""

import math

from longarm_comp.core.arm.spatial import Scalar, absolute, floor, maximum, minimum, where

# pi / 2 in pieces of 33 bits, so that their products with whole numbers are exact, and the rest
_PARTS = (
    1.57079632673412561417e00,
    6.07710050630396597660e-11,
    2.02226624871116645580e-21,
    8.47842766036889956997e-32,
)
_SINE = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
_COSINE = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)


def sine(x: Scalar) -> Scalar:
    """Compute sin x, x in rad."""
    return _quadrant(x, 0.0)


def cosine(x: Scalar) -> Scalar:
    """Compute cos x, x in rad."""
    return _quadrant(x, 1.0)


def _quadrant(x: Scalar, ahead: float) -> Scalar:
    quarters = floor(x * (2 / math.pi) + 0.5)
    r = x
    for part in _PARTS:
        r = r - quarters * part
    z = r * r
    s = r + r * z * _horner(_SINE, z)
    c = 1.0 - 0.5 * z + z * z * _horner(_COSINE, z)
    half = (quarters + ahead) * 0.5
    odd = half - floor(half)  # 0 or 1/2
    turn = 0.5 * floor(half)
    back = turn - floor(turn)
    value = where(odd > 0.25, c, s)
    return where(back > 0.25, -value, value)


def _horner(coefficients: tuple[float, ...], z: Scalar) -> Scalar:
    value: Scalar = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        value = value * z + c
    return value


_ATAN_P = (
    -6.485021904942025371773e1,
    -1.228866684490136173410e2,
    -7.500855792314704667340e1,
    -1.615753718733365076637e1,
    -8.750608600031904122785e-1,
)
_ATAN_Q = (
    1.945506571482613964425e2,
    4.853903996359136964868e2,
    4.328810604912902668951e2,
    1.650270098316988542046e2,
    2.485846490142306297962e1,
    1.0,
)
_LOW = 6.123233995736765886130e-17  # of pi / 2


def arc_tangent2(y: Scalar, x: Scalar) -> Scalar:
    """Return the angle (rad) of the point (x, y), from -pi to pi; 0 at the origin."""
    a, b = absolute(y), absolute(x)
    t = minimum(a, b) / (maximum(a, b) + 1e-300)
    steep = t > 0.66
    r = where(steep, (t - 1.0) / (t + 1.0), t)
    z = r * r
    value = r + r * z * _horner(_ATAN_P, z) / _horner(_ATAN_Q, z)
    value = where(steep, math.pi / 4 + (value + 0.5 * _LOW), value)
    value = where(a > b, math.pi / 2 - (value - _LOW), value)
    value = where(x < 0.0, math.pi - (value - 2 * _LOW), value)
    return where(y < 0.0, -value, value)
