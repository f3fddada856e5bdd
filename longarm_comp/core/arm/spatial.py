"""Rigid motions in components: vectors, frames, twists.

Every scalar may be a Python float (one posture), a NumPy array of shape (N,) (a whole session) or
any other number that supports ``+ - * /`` and the NumPy ufuncs.  A *twist* is ordered
``[d; delta]`` as in the paper's Eq. (3): translation first (m), rotation second (rad), both in the
axes of the frame in which it acts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

Scalar = Any  # float, (N,) array, or a traced number
Vec = tuple[Scalar, Scalar, Scalar]
Twist = tuple[Scalar, Scalar, Scalar, Scalar, Scalar, Scalar]

ZERO: Vec = (0.0, 0.0, 0.0)
ZERO_TWIST: Twist = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def _of_any(of_float: Callable[[float], float], ufunc: np.ufunc) -> Callable[[Scalar], Scalar]:
    """Return a function that uses `of_float` for a float, and the NumPy ufunc for anything else."""
    return lambda x: of_float(x) if type(x) is float else ufunc(x)


sin, cos = _of_any(math.sin, np.sin), _of_any(math.cos, np.cos)
sqrt, tanh = _of_any(math.sqrt, np.sqrt), _of_any(math.tanh, np.tanh)
absolute = _of_any(abs, np.absolute)
sign = _of_any(lambda x: float((x > 0) - (x < 0)), np.sign)
floor = _of_any(lambda x: float(math.floor(x)), np.floor)


def _of_two(of_floats: Callable[..., float], ufunc: np.ufunc) -> Callable[..., Scalar]:
    """Return a function that uses `of_floats` for two floats, and the NumPy ufunc otherwise."""
    return lambda a, b: of_floats(a, b) if type(a) is float and type(b) is float else ufunc(a, b)


atan2 = _of_two(math.atan2, np.arctan2)
"""Angle of the point (x, y), given y and x (rad)."""
minimum, maximum = _of_two(min, np.minimum), _of_two(max, np.maximum)


def where(condition: Scalar, yes: Scalar, no: Scalar) -> Scalar:
    """Return `yes` where the condition holds, else `no` (both sides are evaluated)."""
    if isinstance(condition, (float, int, np.generic)):
        return yes if condition else no
    if isinstance(condition, np.ndarray):
        return np.where(condition, yes, no)
    return condition.where(yes, no)


def add(a: Vec, b: Vec) -> Vec:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def sub(a: Vec, b: Vec) -> Vec:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def scale(s: Scalar, a: Vec) -> Vec:
    return (s * a[0], s * a[1], s * a[2])


def dot(a: Vec, b: Vec) -> Scalar:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vec, b: Vec) -> Vec:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


class Frame(NamedTuple):
    """A pose ``[n o a p; 0 0 0 1]`` (the paper's Eq. 4): three axes and the origin."""

    n: Vec
    o: Vec
    a: Vec
    p: Vec

    def rotate(self, v: Vec) -> Vec:
        """Return the vector `v`, given in this frame's axes, in the parent's axes."""
        n, o, a = self.n, self.o, self.a
        return (
            n[0] * v[0] + o[0] * v[1] + a[0] * v[2],
            n[1] * v[0] + o[1] * v[1] + a[1] * v[2],
            n[2] * v[0] + o[2] * v[1] + a[2] * v[2],
        )

    def unrotate(self, v: Vec) -> Vec:
        """Return the vector `v`, given in the parent's axes, in this frame's axes."""
        return (dot(self.n, v), dot(self.o, v), dot(self.a, v))

    def transform(self, v: Vec) -> Vec:
        """Return the point `v` (m), given in this frame, in the parent frame."""
        return add(self.rotate(v), self.p)

    def along(self, axis: int, length: Scalar) -> Frame:
        """Return this frame moved by `length` (m) along its own axis 0, 1 or 2."""
        return Frame(self.n, self.o, self.a, add(self.p, scale(length, self[axis])))

    def turned_x(self, angle: float) -> Frame:
        """Return this frame turned by `angle` (rad) about its own x axis."""
        if angle == 0.0:
            return self
        c, s = _exact_cos_sin(angle)
        o = add(scale(c, self.o), scale(s, self.a))
        return Frame(self.n, o, sub(scale(c, self.a), scale(s, self.o)), self.p)

    def turned_z(self, angle: Scalar) -> Frame:
        """Return this frame turned by `angle` (rad) about its own z axis."""
        if type(angle) is float and angle == 0.0:
            return self
        c, s = _exact_cos_sin(angle) if type(angle) is float else (cos(angle), sin(angle))
        n = add(scale(c, self.n), scale(s, self.o))
        return Frame(n, sub(scale(c, self.o), scale(s, self.n)), self.a, self.p)

    def __matmul__(self, other: Frame) -> Frame:
        """Return the frame `other`, given in this frame, in the parent frame."""
        n, o, a = self.rotate(other.n), self.rotate(other.o), self.rotate(other.a)
        return Frame(n, o, a, self.transform(other.p))

    def matrix(self) -> np.ndarray:
        """Return the homogeneous matrix, (..., 4, 4)."""
        columns = [np.stack(np.broadcast_arrays(*v), axis=-1) for v in self]
        top = np.stack(np.broadcast_arrays(*columns), axis=-1)
        bottom = np.broadcast_to(np.array([0.0, 0.0, 0.0, 1.0]), (*top.shape[:-2], 1, 4))
        return np.concatenate([top, bottom], axis=-2)


IDENTITY = Frame((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), ZERO)


def _exact_cos_sin(angle: float) -> tuple[float, float]:
    """Compute cos and sin of an angle (rad), exactly 0 or +-1 at multiples of a right angle."""
    quarter = angle / (math.pi / 2)
    if abs(math.remainder(quarter, 1.0)) < 1e-14:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[round(quarter) % 4]
    return math.cos(angle), math.sin(angle)


def exp(twist: Twist) -> Frame:
    """Return the finite motion exp(twist) of a small twist.

    It is a series with an error below 1e-12 for rotations up to 0.3 rad.
    """
    d, w = twist[:3], twist[3:]
    t = dot(w, w)
    a = 1.0 - t * (1 / 6 - t * (1 / 120 - t * (1 / 5040 - t / 362880)))
    return _exp(d, w, a, *_small(t), t)


def exp_large(twist: Twist) -> Frame:
    """Return the finite motion exp(twist) of a twist of any size."""
    d, w = twist[:3], twist[3:]
    t = dot(w, w) + 1e-24
    return _exp(d, w, *_any(t), t)


def _small(t: Scalar) -> tuple[Scalar, Scalar]:
    """Compute ``b = (1 - cos x) / x^2`` and ``c = (x - sin x) / x^3`` for small x, ``t = x^2``."""
    b = 0.5 - t * (1 / 24 - t * (1 / 720 - t * (1 / 40320 - t / 3628800)))
    c = 1 / 6 - t * (1 / 120 - t * (1 / 5040 - t * (1 / 362880 - t / 39916800)))
    return b, c


def _any(t: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Return ``a = sin x / x``, and the b and c of `_small`, for ``t = x^2``, x not 0."""
    angle = sqrt(t)
    a = sin(angle) / angle
    half = sin(0.5 * angle) / angle
    series = 1 / 6 - t * (1 / 120 - t * (1 / 5040))
    return a, 2.0 * half * half, where(t < 1e-4, series, (1.0 - a) / t)


def tangent(twist: Twist, at: Vec, large: bool = False) -> tuple[list[Vec], list[Vec]]:
    """Return the derivatives of the motion ``exp(x)`` of a body by the components of its twist x.

    They are the right Jacobian J: ``exp(x + h) = exp(x) exp(J h)`` for a small h. Let
    ``(d, w) = -x``, and let b and c be the coefficients of `_small`. The blocks of rotation by
    rotation and translation by translation are ``A = 1 + b w^ + c w^w^``. Column j of translation
    by rotation is ``dp/dw_j - (A e_j) x p``, with ``p = A d`` and the unit vector e_j.

    Args:
        twist: x, m and rad.
        at: a point of the carried body, in the frame after the motion (m).
        large: whether x may be large (`exp_large`).

    Returns:
        First the rotation of the body per unit of each rotation component, which is also its
        displacement per unit of each translation component. Second the displacement of the point
        per unit of each rotation component. All vectors are in the frame after the motion.
    """
    if all(type(x) is float and x == 0.0 for x in twist):
        units = IDENTITY[:3]
        return list(units), [cross(e, at) for e in units]
    d, w = scale(-1.0, twist[:3]), scale(-1.0, twist[3:])
    t = dot(w, w)
    b, c = _any(t + 1e-24)[1:] if large else _small(t)
    db = -1 / 24 + t * (1 / 360 - t * (1 / 13440 - t / 907200))
    dc = -1 / 120 + t * (1 / 2520 - t * (1 / 120960 - t / 9979200))
    if large:
        far, safe = t > 1e-2, t + 1e-24
        db = where(far, (1.0 - c * t - 2.0 * b) / (2.0 * safe), db)
        dc = where(far, (b - 3.0 * c) / (2.0 * safe), dc)
    wd, along = cross(w, d), dot(w, d)
    p = add(d, add(scale(b, wd), scale(c, sub(scale(along, w), scale(t, d)))))
    change = add(scale(2.0 * db, wd), scale(2.0 * dc, sub(scale(along, w), scale(t, d))))
    arm = sub(at, p)
    turns, shifts = [], []
    for j, e in enumerate(IDENTITY[:3]):
        turn = add(scale(b, cross(w, e)), scale(c * w[j], w))
        turn = tuple(x + (1.0 - c * t) if i == j else x for i, x in enumerate(turn))
        bent = add(scale(b, cross(e, d)), scale(w[j], sub(change, scale(2.0 * c, d))))
        bent = add(bent, scale(c * d[j], w))
        bent = tuple(x + c * along if i == j else x for i, x in enumerate(bent))
        turns.append(turn)
        shifts.append(add(bent, cross(turn, arm)))
    return turns, shifts


def _exp(d: Vec, w: Vec, a: Scalar, b: Scalar, c: Scalar, t: Scalar) -> Frame:
    """Apply Rodrigues' formula: ``R = 1 + a w^ + b w^w^``, ``p = (1 + b w^ + c w^w^) d``.

    Here ``w^w^ = w w' - t``.
    """
    x, y, z = w
    diag = 1.0 - b * t
    bx, by, bz = b * x, b * y, b * z
    ax, ay, az = a * x, a * y, a * z
    wd = cross(w, d)
    s, u = c * dot(w, d), 1.0 - c * t
    return Frame(
        (diag + bx * x, bx * y + az, bx * z - ay),
        (bx * y - az, diag + by * y, by * z + ax),
        (bx * z + ay, by * z - ax, diag + bz * z),
        (u * d[0] + b * wd[0] + s * x, u * d[1] + b * wd[1] + s * y, u * d[2] + b * wd[2] + s * z),
    )


def small_rotation(a: Frame, b: Frame) -> Vec:
    """Compute the small rotation vector (rad) from frame b to frame a, in their parent's axes.

    It is accurate to second order.  With ``a = (1 + w^) b`` the cross products of the axes of b
    with those of a sum up to ``2 w``.
    """
    total = ZERO
    for before, after in zip(b[:3], a[:3], strict=True):
        total = add(total, cross(before, after))
    return scale(0.5, total)


def sum_twists(parts: Iterable[Mapping[int, Twist]]) -> dict[int, Twist]:
    """Return the sums of several sets of twists (m, rad), by station."""
    total: dict[int, Twist] = {}
    for part in parts:
        for station, twist in part.items():
            held = total.get(station)
            added = twist if held is None else [*map(_plus, held, twist)]
            total[station] = tuple(added)  # type: ignore[assignment]
    return total


def _plus(x: Scalar, y: Scalar) -> Scalar:
    """Return x + y; if one of them is the float 0, the other is returned without a copy."""
    if type(y) is float and y == 0.0:
        return x
    return y if type(x) is float and x == 0.0 else x + y


def rpy_frame(xyz: Vec, rpy: Vec) -> Frame:
    """Return the pose of a position (m) and roll, pitch, yaw (rad) as in URDF.

    The rotation is ``Rz(yaw) Ry(pitch) Rx(roll)``.
    """
    (cr, sr), (cp, sp), (cy, sy) = (_exact_cos_sin(float(a)) for a in rpy)
    return Frame(
        (cy * cp, sy * cp, -sp),
        (cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr),
        (cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr),
        (float(xyz[0]), float(xyz[1]), float(xyz[2])),
    )


def roll_pitch_yaw(rotation: np.ndarray) -> tuple[float, float, float]:
    """Return roll, pitch and yaw (rad) of a matrix (3, 3) ``Rz(yaw) Ry(pitch) Rx(roll)``.

    They are exact at a pitch of +-90 degrees too.
    """
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    level = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ rotation
    pitch = np.arctan2(-level[2, 0], level[0, 0])
    roll = np.arctan2(-level[1, 2], level[1, 1])
    return float(roll), float(pitch), float(yaw)
