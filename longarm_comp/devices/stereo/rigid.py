"""The rigid motion between two sets of points, with its covariance.

Start: Kabsch / Umeyama (IEEE PAMI 13(4), 1991). Then Gauss-Newton with the covariance of every
point. A pose's 6-vector is ``[d; delta]``: translation (m), then rotation (rad), both about the
axes of the target frame, the rotation about the moved origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.devices.stereo.camera import Array
from longarm_comp.math.points import kabsch


@dataclass(frozen=True)
class RigidFit:
    """``to = transform @ from`` (4, 4); covariance (6, 6) m^2, m rad, rad^2; residuals (N, 3) m."""

    transform: Array
    covariance: Array
    residuals: Array
    sigma_scale: float

    @property
    def rms_m(self) -> float:
        """Root mean square length of the residuals, m."""
        return float(np.sqrt(np.mean(np.sum(np.square(self.residuals), axis=1))))


def fit_rigid(source: Array, target: Array, covariances: Array | None = None) -> RigidFit:
    """The rigid motion that takes `source` (N, 3) m to `target` (N, 3) m.

    Args:
        covariances: (N, 3, 3) m^2 of ``target - moved source``; None: equal and isotropic,
            estimated from the residuals.

    Returns:
        The fit. Its covariance is scaled up by the residuals where they exceed what `covariances`
        promise (`sigma_scale` = the square root of that factor, at least 1).
    """
    source, target = np.asarray(source, dtype=float), np.asarray(target, dtype=float)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise InputError("rigid fit", "points", (source.shape, target.shape), "both (N, 3)")
    if len(source) < 3 or not (np.all(np.isfinite(source)) and np.all(np.isfinite(target))):
        raise InputError("rigid fit", "points", len(source), "three or more, finite")
    spread = np.linalg.svd(source - source.mean(axis=0), compute_uv=False)
    if spread[1] < 1e-6 * max(spread[0], 1e-12):
        raise InputError("rigid fit", "points", "all on one line", "points that span a plane")
    rotation, translation = kabsch(source, target, np.ones(len(source)))
    known = covariances is not None
    weights = (
        np.linalg.inv(covariances)
        if covariances is not None
        else np.broadcast_to(np.eye(3), (len(source), 3, 3))
    )
    for _ in range(10):
        arm = source @ rotation.T
        residuals = target - arm - translation
        jacobian = np.concatenate(
            [np.broadcast_to(np.eye(3), (len(arm), 3, 3)), -cross_matrices(arm)], axis=2
        )
        weighted = jacobian.transpose(0, 2, 1) @ weights
        normal = np.sum(weighted @ jacobian, axis=0)
        step = np.linalg.solve(normal, np.sum(weighted @ residuals[..., None], axis=0)[:, 0])
        translation = translation + step[:3]
        rotation = cv2.Rodrigues(step[3:])[0] @ rotation
        if np.max(np.abs(step)) < 1e-12:
            break
    else:
        if np.max(np.abs(step)) > 1e-6:
            raise JobError("rigid fit did not settle", last_step=float(np.max(np.abs(step))))
    residuals = target - source @ rotation.T - translation
    chi2 = float(np.einsum("ni,nij,nj->", residuals, weights, residuals))
    factor = chi2 / max(3 * len(source) - 6, 1)
    factor = max(factor, 1.0) if known else factor
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, translation
    return RigidFit(transform, factor * np.linalg.inv(normal), residuals, float(np.sqrt(factor)))


def cross_matrices(vectors: Array) -> Array:
    """(N, 3, 3) matrices S with ``S w = v x w`` for v of `vectors` (N, 3)."""
    out = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -z, y, -x
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = z, -y, x
    return out
