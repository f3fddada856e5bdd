"""Finds the pose of the stereo head from a session that it measured: hand-eye calibration."""

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.model import Model
from longarm_comp.devices.stereo.calibrate import hand_eye

FEWEST_POSES = 10
"""Smallest number of poses: thirty numbers for six unknowns leave enough to find outliers and hold
rows out."""
_SIGMA_M = 1e-4
"""Noise of a sighting if the session states none. The arm's own errors show in the residual."""
_FOLLOWS = 0.2
"""Largest error of rows held out, as a share of how far the tips lie apart (both rms). Sightings of
another arm or of other poses lie as far off as the tips lie apart."""


@dataclass(frozen=True)
class HeadPlacement:
    """The pose of the left optical frame in the base frame."""

    pose: np.ndarray  # (4, 4)
    position_sd_mm: np.ndarray  # (3,) each, one standard deviation, base axes
    rotation_sd_deg: np.ndarray
    residual_mm: float  # RMS distance of the sightings, without outliers, from the predicted tips
    held_out_mm: float  # the same for rows that were left out of the fit (five folds)
    moved_mm: float  # distance and angle from the assumed pose
    turned_deg: float
    rows: int  # numbers of rows used and left out
    outliers: int


def placed_cameras(model: Model, session: Session, assumed: np.ndarray) -> HeadPlacement:
    """Fit the pose of the stereo head to rows in which it measured the tip.

    Args:
        assumed: (4, 4) left optical frame in the base frame with which the sightings were computed.

    Raises:
        InputError: fewer than `FEWEST_POSES` rows have a position.
        JobError: the tip stayed on a line or at a point, or the sightings do not follow it.
    """
    rows = session.take(session.has_position)
    if len(rows) < FEWEST_POSES:
        allowed = f"at least {FEWEST_POSES} rows with x, y and z"
        raise InputError(session.source, "rows", len(rows), allowed)
    tips = model.tip(rows.q, rows.context())
    spread = np.linalg.svd(tips - tips.mean(axis=0), compute_uv=False)
    wide = 2.0 * spread / np.sqrt(len(rows))
    # The tips must reach over so much in two directions, or the head's rotation is hardly told
    if wide[1] < 0.05:
        why = "the tip stayed on a line or at a point: measure poses over its whole range"
        raise JobError(why, spread_mm=[round(1e3 * float(w)) for w in wide])
    turn = assumed[:3, :3]
    seen = (rows.xyz - assumed[:3, 3]) @ turn
    sigma = np.full((len(rows), 3), _SIGMA_M) if rows.sigma is None else rows.sigma
    sigma = np.where(np.isfinite(sigma) & (sigma > 0), sigma, _SIGMA_M)
    covariances = turn.T @ (sigma[:, :, None] ** 2 * np.eye(3)) @ turn
    fit = hand_eye(tips, seen, covariances)
    good = np.setdiff1d(np.arange(len(rows)), fit.outliers)
    squares = np.zeros(len(rows))  # m^2, of the distance from a fit without the row
    for out in (good[fold::5] for fold in range(5)):
        kept = np.setdiff1d(good, out)
        camera = hand_eye(tips[kept], seen[kept], covariances[kept]).camera_in_base
        off = seen[out] @ camera[:3, :3].T + camera[:3, 3] - tips[out]
        squares[out] = np.sum(off**2, axis=1)
    held_out_m = float(np.sqrt(np.mean(squares[good])))
    if held_out_m > _FOLLOWS * float(np.linalg.norm(spread)) / np.sqrt(len(rows)):
        why = "the sightings do not follow the arm: is it a session of this arm, joints and marker?"
        raise JobError(why, held_out_mm=round(1e3 * held_out_m, 1))
    sd = np.sqrt(np.diag(fit.covariance))
    moved = np.linalg.inv(assumed) @ fit.camera_in_base
    angle = np.arccos(np.clip((np.trace(moved[:3, :3]) - 1) / 2, -1.0, 1.0))
    return HeadPlacement(
        pose=fit.camera_in_base,
        position_sd_mm=1e3 * sd[:3],
        rotation_sd_deg=np.degrees(sd[3:6]),
        residual_mm=1e3 * fit.rms_m,
        held_out_mm=1e3 * held_out_m,
        moved_mm=1e3 * float(np.linalg.norm(moved[:3, 3])),
        turned_deg=float(np.degrees(angle)),
        rows=len(good),
        outliers=len(fit.outliers),
    )
