"""Places a base by coordinates, distances, rays and axes, none of them a whole position.

With the base's rotation R and place p as twelve free numbers ("lifting"), most readings of a tip
whose place o in the base is predicted are linear: ``c . (R o + p) = v``.  A coordinate has c along
its axis; a ray two of them across it, through its camera.  Distances to an anchor give its place
in the base (multilateration), a point whose sighting is declared.  Axes give R alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.kinds import by_name, compute_axes_across, compute_rotations
from longarm_comp.core.data.session import Session
from longarm_comp.math.points import ROUNDS, nearest_rotation, robust_kabsch, robust_weights

_MIN_EQUATIONS = 4
"""Distances to an anchor, or equations of a base, at least: three leave a mirror image."""
_SEEN_SHARE = 0.1
"""Singular value of R, in the largest, below which its direction was not measured; of a rotation
all are 1."""
_FAR_MEDIANS = 6.0
"""Misfit of a distance, in their median, from which it is left out: four standard deviations."""
_LEAST_TURN_RAD, _MOST_TURN_RAD = 0.05, 2.8
"""Turns between two rows that tell the axis of the turn: noise tilts that of smaller ones, and near
pi its sign is not known."""
_RANK, EXACT = 1e-6, 1e-9
"""Share of the largest singular value, and length (m), below which there is rounding only."""


class _LinearEquations(NamedTuple):
    """``direction . (R point + p) = value``: (M, 3) unit vectors in the frame of the
    measurements, (M, 3) m in the base, (M,) m."""

    direction: np.ndarray
    point: np.ndarray
    value: np.ndarray


def lifted_base(
    arm: Arm, points: np.ndarray, axes: np.ndarray, rows: Session
) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation (3, 3) and place (3,) m of the base that agree with N rows measured from it.

    What they do not determine is left as declared: the base unturned and at the origin.

    Args:
        points, axes: of N predicted tips in the base: (N, 3) m; (N, 3, 3) in columns.
    """
    parts = _linear_equations(arm, points, rows)
    found = _LinearEquations(*map(np.concatenate, zip(*parts, strict=True)))
    turn = _solve_rotation_by_axes(axes, rows)
    if turn is None:
        turn = _solve_rotation(found) if len(found.value) >= _MIN_EQUATIONS else np.eye(3)
    right = found.value - np.einsum("mi,ij,mj->m", found.direction, turn, found.point)
    return turn, _robust(found.direction, right) if len(right) else np.zeros(3)


def multilaterate(points: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Return the place (3,) of an anchor by N >= 4 distances (N,) from points (N, 3), m."""
    kept = np.ones(len(length), dtype=bool)
    for _ in range(ROUNDS):
        place = _fit_anchor(points[kept], length[kept])
        miss = np.abs(np.linalg.norm(points - place, axis=1) - length)
        closer = miss <= max(_FAR_MEDIANS * float(np.median(miss)), EXACT)
        if closer.sum() < _MIN_EQUATIONS or (closer == kept).all():
            break
        kept = closer
    return place


def _fit_anchor(points: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Fit the place (3,) of an anchor to its distances, by least squares.

    ``|p|^2 - d^2 = 2 p.a - |a|^2`` is linear in a, but weighs far points more than they deserve, so
    the distances themselves are fitted after it.  Points in a plane leave its side open.
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
    """Yield the equations of coordinates, of rays, and of declared anchors.

    Each anchor is placed in the base by its distances, as a point that was seen.
    """
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
    """Solve R from axes ``A = R B X`` of any body X: between rows ``A_i A_j' = R B_i B_j' R'``."""
    turned = rows.take(rows.has_orientation)
    if len(turned) < _MIN_EQUATIONS:
        return None
    body = np.char.add(turned.texts("marker"), turned.texts("sensor"))
    seen, mine = compute_rotations(turned.readings["orientation"]), axes[rows.has_orientation]
    pairs = (np.roll(a, 1, axis=0) @ np.swapaxes(a, 1, 2) for a in (seen, mine))
    to, of = (Rotation.from_matrix(pair).as_rotvec() for pair in pairs)
    angle = np.linalg.norm(of, axis=1)
    kept = (angle > _LEAST_TURN_RAD) & (angle < _MOST_TURN_RAD) & (np.roll(body, 1) == body)
    if kept.sum() < 2:
        return None
    of, to = np.concatenate([of[kept], -of[kept]]), np.concatenate([to[kept], -to[kept]])
    return robust_kabsch(of, to)[0]  # each turn is there both ways, so the offset is 0


def _solve_rotation(found: _LinearEquations) -> np.ndarray:
    """Return R of the lifted problem, brought back to a rotation."""
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
    if s[1] > _SEEN_SHARE * s[0]:
        return turn
    axis = u[:, 0]  # the turn about it was not measured: the smallest rotation of those left
    cross = np.cross(np.eye(3), axis)  # the matrix of v -> axis x v
    flat = np.eye(3) - np.outer(axis, axis)
    angle = np.arctan2(np.trace(cross @ turn), np.trace(flat @ turn))
    return np.asarray(Rotation.from_rotvec(angle * axis).as_matrix() @ turn)


def _robust(design: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve by least squares of smallest norm, the farther half of the equations counted less."""
    weights = np.ones(len(right))
    for _ in range(ROUNDS):
        root = np.sqrt(weights)
        x = np.linalg.lstsq(design * root[:, None], right * root, rcond=_RANK)[0]
        weights = robust_weights(np.abs(right - design @ x))
    return np.asarray(x)
