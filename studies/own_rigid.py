"""A rigid calibration that shares nothing with the package: Craig's chain, fitted by scipy.

It is the peer that every figure of a real arm stands beside.  Each row of the chain has six errors,
the base six, each marker (or the tip) three, each touched point three.  A weak pull to the declared
arm makes the redundant ones definite; Huber's loss bears gross errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session

PULL = 1e-3
"""Of an error of 10 mm or 10 mrad, beside a residual of the size of `SCALE_M`."""
SIZE = 1e-2
SCALE_M = 1e-3
"""Residual from which on Huber's loss is linear."""


@dataclass(frozen=True, eq=False)
class OwnRigid:
    """A rigid arm and what its tip is seen as.

    Attributes:
        arm: as declared.
        errors: (6 (rows + 1),) base, then every row: rotation vector (rad), translation (m).
        tips: (3,) m by marker, in the frame of the last row; ``""`` where there is one tip.
    """

    arm: Arm
    errors: np.ndarray
    tips: dict[str, np.ndarray]

    @classmethod
    def fit(cls, arm: Arm, session: Session) -> OwnRigid:
        """Fit by least squares rows with positions, or with touches of unknown points."""
        names = list(np.unique(session.texts("marker")))
        points = np.unique(session.labels["touch"]) if _is_touched(session) else np.array([])
        tip = np.array(arm.tip.position_m)
        declared = cls(arm, np.zeros(6 * (len(arm.joints) + 1)), dict.fromkeys(names, tip))
        seen = declared.points(session)
        base = np.zeros(6) if len(points) else _register_base(seen, session.xyz)
        width = len(declared.errors)
        first = [seen[session.labels["touch"] == p].mean(axis=0) for p in points]
        start = np.concatenate([base, declared.errors[6:], *[tip] * len(names), *first])
        end = width + 3 * len(names)

        def rebuild(x: np.ndarray) -> OwnRigid:
            tips = x[width:end].reshape(-1, 3)
            return cls(arm, x[:width], dict(zip(names, tips, strict=True)))

        def residual(x: np.ndarray) -> np.ndarray:
            at = x[end:].reshape(-1, 3)
            where = session.xyz
            if len(points):
                where = at[np.searchsorted(points, session.labels["touch"])]
            gaps = [
                (np.linalg.norm(_of(points, at, a) - _of(points, at, b)) - metres) / sigma
                for a, b, metres, sigma in session.touch_distances
                if a in points and b in points
            ]
            pull = PULL / SIZE * x[6:width]
            off = (where - rebuild(x).points(session)).ravel() / SCALE_M
            return np.concatenate([off, np.array(gaps), pull])

        near = least_squares(residual, start, x_scale="jac", max_nfev=60).x
        return rebuild(least_squares(residual, near, loss="huber", max_nfev=60).x)

    def points(self, session: Session) -> np.ndarray:
        """Return (N, 3) m, where the tip or marker of each row is."""
        matrix, offset = self.arm.mixing
        joints = session.q @ matrix.T + offset
        turn, at = _as_motion(self.errors[:6])
        for k, row in enumerate(self.arm.joints[: self.arm.tip.frame]):
            angle, slide = np.radians(row.theta_offset_deg), row.d_m
            along = np.zeros((len(session), 3))
            slides = row.type == "prismatic"
            turned = angle if slides or row.type == "fixed" else angle + joints[:, k]
            along[:, 2] = slide + joints[:, k] if slides else slide
            if row.pose is not None:
                at = at + turn.apply(row.pose.xyz_m)
                turn = turn * Rotation.from_euler("xyz", row.pose.rpy_deg, degrees=True)
            else:
                lean = Rotation.from_euler("x", np.radians(row.alpha_deg))
                at = at + turn.apply([row.a_m, 0.0, 0.0])
                turn = turn * lean
                at = at + turn.apply(along)
                turn = turn * Rotation.from_rotvec(
                    np.multiply.outer(np.broadcast_to(turned, len(session)), [0.0, 0.0, 1.0])
                )
            error, shift = _as_motion(self.errors[6 * (k + 1) : 6 * (k + 2)])
            at, turn = at + turn.apply(shift), turn * error
        tips = np.array([self.tips[name] for name in session.texts("marker")])
        return np.asarray(at + turn.apply(tips))

    def left(self, session: Session) -> np.ndarray:
        """Return distances (N,), m, of rows from what they say; touches from their point's mean."""
        points = self.points(session)
        if not _is_touched(session):
            return np.asarray(np.linalg.norm(session.xyz - points, axis=1))
        touched = session.labels["touch"]
        mean = {name: points[touched == name].mean(axis=0) for name in np.unique(touched)}
        return np.linalg.norm(points - np.array([mean[name] for name in touched]), axis=1)


def _as_motion(six: np.ndarray) -> tuple[Rotation, np.ndarray]:
    return Rotation.from_rotvec(six[:3]), six[3:]


def _register_base(points: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return the base from which points (N, 3) are nearest to those seen (Kabsch 1976)."""
    middle, there = points.mean(axis=0), seen.mean(axis=0)
    turn = Rotation.align_vectors(seen - there, points - middle)[0]
    return np.concatenate([turn.as_rotvec(), there - turn.apply(middle)])


def _of(names: np.ndarray, at: np.ndarray, name: str) -> np.ndarray:
    return np.asarray(at[np.searchsorted(names, name)])


def _is_touched(session: Session) -> bool:
    return "touch" in session.labels and not session.has_position.any()
