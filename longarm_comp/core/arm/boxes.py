"""Boxes that the arm must keep out of, as `arm.yaml` declares them."""

from __future__ import annotations

import numpy as np
from pydantic import model_validator

from longarm_comp.core.arm.pose import Vec3
from longarm_comp.core.yaml_file import Declared, Misdeclared


class Box(Declared):
    """A box in the base frame, its sides along the axes."""

    min_m: Vec3
    max_m: Vec3

    @model_validator(mode="after")
    def _ordered(self) -> Box:
        if any(low >= high for low, high in zip(self.min_m, self.max_m, strict=True)):
            raise Misdeclared("max_m", list(self.max_m), f"above min_m, {list(self.min_m)}")
        return self

    def holds(self, points: np.ndarray) -> np.ndarray:
        """(...) bool: which of points (..., 3), m, are in the box."""
        inside = (points >= np.array(self.min_m)) & (points <= np.array(self.max_m))
        return np.asarray(inside.all(axis=-1))

    def crossed(self, points: np.ndarray) -> np.ndarray:
        """(..., k - 1) bool: which segments of polylines (..., k, 3), m, are partly in the box."""
        begin, way = points[..., :-1, :], np.diff(points, axis=-2)
        low, high = np.array(self.min_m), np.array(self.max_m)
        with np.errstate(divide="ignore", invalid="ignore"):
            near, far = (low - begin) / way, (high - begin) / way
        inside = (begin >= low) & (begin <= high)
        still = way == 0.0  # along this axis: all of the segment is between the planes, or none
        enter = np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(near, far))
        leave = np.where(still, np.where(inside, np.inf, -np.inf), np.maximum(near, far))
        first = np.maximum(enter.max(axis=-1), 0.0)
        last = np.minimum(leave.min(axis=-1), 1.0)
        return np.asarray(first <= last)
