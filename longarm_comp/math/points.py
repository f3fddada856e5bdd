"""The rigid motion from one set of points to another, and lengths of vectors."""

import numpy as np


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths (...) of vectors (..., k): `np.linalg.norm`, but quick for a few."""
    return np.asarray(np.sqrt(np.einsum("...i,...i", vectors, vectors)))


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) nearest to a matrix: its orthogonal part, never a mirror."""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def kabsch(
    points: np.ndarray, seen: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation (3, 3) and offset (3,) that best move points (N, 3) to `seen` (N, 3).

    It is a least-squares fit with weights (N,) (Kabsch 1976).
    """
    share = (weights / weights.sum())[:, None]
    a, b = (share * points).sum(0), (share * seen).sum(0)
    rotation = nearest_rotation((share * (seen - b)).T @ (points - a))
    return rotation, b - rotation @ a


ROUNDS = 6
"""Rounds of `robust_kabsch`: after them the weights do not change any more."""


def robust_weights(distance: np.ndarray) -> np.ndarray:
    """Return weights (N,): 1 up to the median of N distances, beyond it falling as 1 / d^2."""
    return 1.0 / np.maximum(1.0, distance / max(float(np.median(distance)), 1e-12)) ** 2


def robust_kabsch(points: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit as `kabsch` does, in `ROUNDS` rounds, each with `robust_weights` of the one before."""
    weights = np.ones(len(points))
    for _ in range(ROUNDS):
        rotation, offset = kabsch(points, seen, weights)
        weights = robust_weights(np.linalg.norm(seen - points @ rotation.T - offset, axis=1))
    return rotation, offset
