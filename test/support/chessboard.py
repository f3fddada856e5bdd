"""A plain chessboard as a target, as in the photographs of a real stereo rig."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from longarm_comp.devices.stereo.camera import Array
from longarm_comp.devices.stereo.saddle import refine_saddles
from longarm_comp.devices.stereo.target import Corners, Grey


@dataclass(frozen=True)
class Chessboard:
    """A plain chessboard (for calibration), with `columns` x `rows` inner corners.

    One of the two must be odd and the other even, or the board looks the same upside down.
    """

    square_m: float
    columns: int
    rows: int

    @property
    def n_corners(self) -> int:
        """Inner corners."""
        return self.columns * self.rows

    def points(self, ids: NDArray[np.int64]) -> Array:
        """Inner corners (N, 3) m, counted along the rows."""
        row, column = np.divmod(ids, self.columns)
        x, y = column - (self.columns - 1) / 2, (self.rows - 1) / 2 - row
        return self.square_m * np.column_stack([x, y, np.zeros(len(ids))])

    def detect(self, grey: Grey) -> Corners:
        """All inner corners or none."""
        ok, found = cv2.findChessboardCorners(grey, (self.columns, self.rows))
        if not ok:
            return Corners()
        grid = self._ordered(grey, np.asarray(found).reshape(self.rows, self.columns, 2))
        pixels = np.ascontiguousarray(grid, dtype=np.float32).reshape(-1, 1, 2)
        steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
        near = int(np.clip(0.3 * min(steps), 2, 7))
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-3)
        cv2.cornerSubPix(grey, pixels, (near, near), (-1, -1), stop)
        half = int(np.clip(0.55 * min(steps), 3, 15))
        refined = refine_saddles(grey, pixels.reshape(-1, 2).astype(float), half)
        return Corners(np.arange(self.n_corners), refined)

    @staticmethod
    def _ordered(grey: Grey, grid: Array) -> Array:
        """Corners (rows, columns, 2) so that both cameras count from the same one.

        Rows go down where columns go right, and the first inner square is a dark one.
        """
        (ax, ay), (bx, by) = grid[0, 1] - grid[0, 0], grid[1, 0] - grid[0, 0]
        if ax * by - ay * bx < 0.0:
            grid = grid[::-1]
        first, second = (grid[:2, i : i + 2].reshape(-1, 2).mean(axis=0) for i in (0, 1))
        at = np.rint([first, second]).astype(int)
        smooth = cv2.blur(grey, (5, 5))
        light = smooth[at[:, 1], at[:, 0]]
        return grid if light[0] < light[1] else grid[::-1, ::-1]
