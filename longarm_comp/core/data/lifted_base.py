"""Finds the pose of a base from coordinates, distances, rays and orientations.

It is for sessions without whole positions.  If the base's rotation R and position p are taken as
twelve independent numbers ("lifting"), most readings are linear: ``c . (R o + p) = v`` with the
predicted tip o in the base frame. A coordinate gives one equation: v is its value, and c its axis.
A ray gives two, each with a c perpendicular to the ray.  Distances to an anchor of known place give
its position in the base (multilateration), and so three equations.  Orientations give R alone.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.kinds import by_name, compute_axes_across, compute_rotations
from longarm_comp.core.data.session import Session
from longarm_comp.math.points import ROUNDS, nearest_rotation, robust_kabsch, robust_weights

_MIN_EQUATIONS = 4
"""Smallest number of distances to an anchor, or of equations of a base: 3 leave a mirror image."""
_RANK, EXACT = 1e-6, 1e-9
"""Ratio to the largest singular value, and length (m), below which a value is rounding error."""


class _LinearEquations(NamedTuple):
    """M equations ``direction . (R point + p) = value`` of the base's pose (R, p)."""

    direction: np.ndarray  # (M, 3) unit vectors in the frame of the measurements
    point: np.ndarray  # (M, 3) m, in the base frame
    value: np.ndarray  # (M,) m


def lifted_base(
    arm: Arm, points: np.ndarray, axes: np.ndarray, rows: Session
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation (3, 3) and position (3,), m, of the base that agree best with N rows.

    Where the rows do not determine them, the rotation is the smallest one and the position the one
    closest to the origin.

    Args:
        points: (N, 3) predicted tips in the base frame, m.
        axes: (N, 3, 3) axes of these tips in the base frame, as columns.
        rows: the N measured rows.
    """
    parts = _linear_equations(arm, points, rows)
    found = _LinearEquations(*map(np.concatenate, zip(*parts, strict=True)))
    turn = _solve_rotation_by_axes(axes, rows)
    if turn is None:
        turn = _solve_rotation(found) if len(found.value) >= _MIN_EQUATIONS else np.eye(3)
    right = found.value - np.einsum("mi,ij,mj->m", found.direction, turn, found.point)
    return turn, _robust(found.direction, right) if len(right) else np.zeros(3)


def multilaterate(points: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Return the position (3,) of an anchor, m, from its distances to known points, robustly.

    Args:
        points: (N, 3) m, N >= 4.
        length: (N,) distances of the anchor from these points, m.
    """
    kept = np.ones(len(length), dtype=bool)
    for _ in range(ROUNDS):
        place = _fit_anchor(points[kept], length[kept])
        miss = np.abs(np.linalg.norm(points - place, axis=1) - length)
        # for normal errors six medians are four standard deviations
        closer = miss <= max(6.0 * float(np.median(miss)), EXACT)
        if closer.sum() < _MIN_EQUATIONS or (closer == kept).all():
            break
        kept = closer
    return place


def _fit_anchor(points: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Fit the position (3,) of an anchor to its distances by least squares.

    ``|p|^2 - d^2 = 2 p.a - |a|^2`` is linear in a and |a|^2, but gives too much weight to far
    points.  So its solution is only the start of a fit to the distances themselves.  If all points
    lie in a plane, the anchor may be found on the wrong side of it.
    """
    middle = points.mean(axis=0)
    local = points - middle
    design = np.column_stack([2.0 * local, -np.ones(len(local))])
    place = np.linalg.lstsq(design, (local**2).sum(axis=1) - length**2, rcond=None)[0][:3]
    for _ in range(ROUNDS):
        away = place - local
        far = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        place = place + np.linalg.lstsq(away / far[:, None], length - far, rcond=None)[0]
    return np.asarray(place + middle)


def _linear_equations(arm: Arm, points: np.ndarray, rows: Session) -> Iterator[_LinearEquations]:
    """Yield the equations of coordinates, of rays, and of anchors, located by their distances."""
    for k, axis in enumerate(np.eye(3)):
        some = np.isfinite(rows.xyz[:, k])
        directions = np.broadcast_to(axis, (int(some.sum()), 3))
        yield _LinearEquations(directions, points[some], rows.xyz[some, k])
    if "ray" in rows.readings:
        some = np.isfinite(rows.readings["ray"]).all(axis=1)
        frames = by_name(arm.camera_frame, rows.labels["sensor"][some])
        for k in range(2):
            local = compute_axes_across(rows.readings["ray"][some])[:, k]
            directions = np.einsum("nij,nj->ni", frames[:, :, :3], local)
            value = (directions * frames[:, :, 3]).sum(axis=1)
            yield _LinearEquations(directions, points[some], value)
    if "distance" in rows.readings:
        length = rows.readings["distance"][:, 0]
        for name, anchor in arm.anchors.items():
            some = np.isfinite(length) & (rows.labels["anchor"] == name)
            count = int(some.sum())  # as many equations as distances
            if anchor.xyz_m is not None and count >= _MIN_EQUATIONS:
                place = np.tile(multilaterate(points[some], length[some]), (3 * count, 1))
                directions = np.tile(np.eye(3), (count, 1))
                yield _LinearEquations(directions, place, np.tile(anchor.xyz_m, count))


def _solve_rotation_by_axes(axes: np.ndarray, rows: Session) -> np.ndarray | None:
    """Return the base's rotation R (3, 3) from measured orientations; None if there are too few.

    An orientation is ``A = R B X`` with the predicted axes B and the unknown rotation X of the
    tracked body on the tip.  Between two rows X cancels: ``A_i A_j' = R B_i B_j' R'``.
    """
    turned = rows.take(rows.has_orientation)
    if len(turned) < _MIN_EQUATIONS:
        return None
    body = np.char.add(turned.texts("marker"), turned.texts("sensor"))
    seen, mine = compute_rotations(turned.readings["orientation"]), axes[rows.has_orientation]
    pairs = (np.roll(a, 1, axis=0) @ np.swapaxes(a, 1, 2) for a in (seen, mine))
    to, of = (Rotation.from_matrix(pair).as_rotvec() for pair in pairs)
    angle = np.linalg.norm(of, axis=1)
    # the axis of a smaller rotation (rad) is too noisy, and near pi its sign is not known
    kept = (angle > 0.05) & (angle < 2.8) & (np.roll(body, 1) == body)
    if kept.sum() < 2:
        return None
    of, to = np.concatenate([of[kept], -of[kept]]), np.concatenate([to[kept], -to[kept]])
    return robust_kabsch(of, to)[0]  # each turn is there both ways, so the offset is 0


def _solve_rotation(found: _LinearEquations) -> np.ndarray:
    """Return the rotation (3, 3) that is nearest to the matrix R of the lifted problem."""
    middle = found.point.mean(axis=0)
    local = found.point - middle
    turned = (found.direction[:, :, None] * local[:, None, :]).reshape(-1, 9)
    design = np.column_stack([turned, found.direction])
    origin = np.linalg.lstsq(found.direction, found.value, rcond=_RANK)[0]
    value = found.value - found.direction @ origin
    if np.abs(value).max() > EXACT:
        free = _robust(design, found.value)[:9].reshape(3, 3)
    else:  # one camera: its rays fit at any scale
        free = np.linalg.svd(design)[2][-1][:9].reshape(3, 3)
        free = free * np.sign(np.linalg.det(free))
    u, s, _ = np.linalg.svd(free)
    if s[0] < EXACT:
        return np.eye(3)
    turn = nearest_rotation(free)
    if s[1] > 0.1 * s[0]:  # of a rotation all are 1: this direction was measured
        return turn
    axis = u[:, 0]  # the turn about it was not measured: the smallest rotation of those left
    cross = np.cross(np.eye(3), axis)  # the matrix of v -> axis x v
    flat = np.eye(3) - np.outer(axis, axis)
    angle = np.arctan2(np.trace(cross @ turn), np.trace(flat @ turn))
    return np.asarray(Rotation.from_rotvec(angle * axis).as_matrix() @ turn)


def _robust(design: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the least-squares solution of smallest norm, with `robust_weights`."""
    weights = np.ones(len(right))
    for _ in range(ROUNDS):
        root = np.sqrt(weights)
        x = np.linalg.lstsq(design * root[:, None], right * root, rcond=_RANK)[0]
        weights = robust_weights(np.abs(right - design @ x))
    return np.asarray(x)
