"""Unit quaternions (x, y, z, w), as messages and files carry orientations.

Source: Diebel, Representing Attitude (2006), eqs. 125 and 290; Shepperd (1978) for the branch that
keeps the inverse well conditioned.
"""

import math

import numpy as np

LENGTH_TOLERANCE = 1e-3
"""Largest accepted deviation of a quaternion's length from 1, as printing few digits causes."""


def is_unit(quaternion: np.ndarray) -> bool:
    """Tell whether x, y, z, w are finite and of length 1 within `LENGTH_TOLERANCE`."""
    length = math.hypot(*quaternion.tolist())
    return math.isfinite(length) and abs(length - 1.0) <= LENGTH_TOLERANCE


def from_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the quaternion (4,), x, y, z, w with w >= 0, of a rotation matrix (3, 3)."""
    m = np.asarray(matrix, dtype=float)
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    squares = np.array([m[0, 0], m[1, 1], m[2, 2], trace])
    k = int(np.argmax(squares))
    if k == 3:
        q = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 1 + trace])
    else:
        i, j = (k + 1) % 3, (k + 2) % 3
        q = np.empty(4)
        q[k] = 1 + 2 * m[k, k] - trace
        q[i], q[j] = m[i, k] + m[k, i], m[j, k] + m[k, j]
        q[3] = m[j, i] - m[i, j]
    q /= np.linalg.norm(q)
    return -q if q[3] < 0 else q


def rotation_vector(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation vector (3,), rad, of a quaternion x, y, z, w with w >= 0."""
    x, y, z, w = (float(v) for v in quaternion)
    sine = math.hypot(x, y, z)
    return np.array([x, y, z]) * (2 * math.atan2(sine, w) / sine if sine else 2.0)


def compute_pose(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Return the matrix (4, 4) of a position (m) and a quaternion x, y, z, w of any length."""
    x, y, z, w = (np.asarray(quaternion, float) / np.linalg.norm(quaternion)).tolist()
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = position
    return matrix


def interpolate(one: np.ndarray, two: np.ndarray, share: float) -> np.ndarray:
    """Return the quaternion (4,) at a fraction of the shortest rotation from one to two (slerp).

    Source: Shoemake, Animating Rotation with Quaternion Curves (1985).
    """
    cosine = float(one @ two)
    two, cosine = (-two, -cosine) if cosine < 0 else (two, cosine)
    angle = math.acos(min(1.0, cosine))
    if angle < 1e-6:  # slerp and linear interpolation are the same
        mixed = (1 - share) * one + share * two
    else:
        mixed = math.sin((1 - share) * angle) * one + math.sin(share * angle) * two
    return np.asarray(mixed / np.linalg.norm(mixed))


def compute_tilt(quaternion: np.ndarray) -> tuple[float, float]:
    """Return roll and pitch (rad) about the fixed x and y axes, as an inclinometer reads them."""
    x, y, z, w = (float(v) for v in quaternion)
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return roll, math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
