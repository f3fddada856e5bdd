"""Refuses faults that more views do not cure: a turned camera, or pictures paired wrongly."""

from collections.abc import Sequence

import cv2
import numpy as np

from longarm_comp.core.errors import JobError
from longarm_comp.devices.stereo.views import FEWEST_CORNERS, BoardView

_TOLD_FROM = 3
"""Smallest number of views for a check: in a single one the board may be held in an unusual way."""
_LEAST_OFF_PX, _TELLING_SHARE = 3.0, 0.3
"""Epipolar distance, px, above which pairs are suspect (lens distortion causes less); and the share
of it below which another pairing of the pictures counts as the right one."""


def check_mounting(views: Sequence[BoardView]) -> None:
    """Refuse views whose right pictures are turned against the left or were taken at other times.

    Raises:
        JobError: one camera is turned, or the pairs are shifted; the message says by how much.
    """
    if len(views) < _TOLD_FROM:
        return
    turned = 0j  # sum of unit numbers: rotation of the right corners against the left
    for view in views:
        _, left, right = view.left.shared_corners(view.right)
        here, there = ((px - px.mean(axis=0)) @ (1, 1j) for px in (left, right))
        turn = np.vdot(here, there)
        turned += turn / abs(turn)
    quarters = round(np.angle(turned, deg=True) / 90) % 4
    if quarters:
        how, by = ("upside down", 180) if quarters == 2 else ("on its side", 90)
        raise JobError(
            f"one camera is {how}: the right pictures are turned by {by} deg against the left; "
            "turn the camera, or its pictures in its driver",
            views=len(views),
        )
    as_paired = _off_px(views, 0)
    if as_paired < _LEAST_OFF_PX:
        return
    tried = {shift: _off_px(views, shift) for shift in (1, -1, 2, -2)}
    best = min(tried, key=tried.__getitem__)
    if tried[best] < _TELLING_SHARE * as_paired:
        where = "later" if best > 0 else "earlier"
        raise JobError(
            f"the pairs look shifted: a left picture belongs to the right one {abs(best)} {where}",
            epipolar_px=f"{as_paired:.3g} -> {tried[best]:.3g}",
        )


def _off_px(views: Sequence[BoardView], shift: int) -> float:
    """Return the median distance, px, of right corners from the epipolar lines of the left ones.

    Each left picture is paired with the right one that is ``shift`` later. Infinite: too few views
    have enough common corners. The lines are fitted to the corners, without a calibration (Zhang,
    Determining the Epipolar Geometry, 1998), so lens distortion adds little.
    """
    pairs = zip(views[max(-shift, 0) :], views[max(shift, 0) :], strict=False)
    common = [one.left.shared_corners(two.right)[1:] for one, two in pairs]
    common = [pair for pair in common if len(pair[0]) >= FEWEST_CORNERS]
    if len(common) < _TOLD_FROM:
        return np.inf
    left, right = (np.vstack(side) for side in zip(*common, strict=True))
    matrix, _ = cv2.findFundamentalMat(left, right, cv2.FM_LMEDS)
    if matrix is None or matrix.shape != (3, 3):
        return np.inf
    lines = cv2.computeCorrespondEpilines(left.reshape(-1, 1, 2), 1, matrix)[:, 0]
    off = np.abs(np.sum(lines * np.column_stack([right, np.ones(len(right))]), axis=1))
    return float(np.median(off))
