"""The rigid motion from one set of points to another."""

from __future__ import annotations

import numpy as np


def kabsch(
    points: np.ndarray, seen: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and offset (3,) of (N, 3) points to sightings, weighted (Kabsch 1976)."""
    share = (weights / weights.sum())[:, None]
    a, b = (share * points).sum(0), (share * seen).sum(0)
    u, _, vt = np.linalg.svd((share * (seen - b)).T @ (points - a))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rotation, b - rotation @ a
