"""Alignment of two sets of points: best rotation and offset, best swap of axes."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from longarm_comp.math.points import kabsch


@dataclass(frozen=True, eq=False)
class Alignment:
    """``measured ~ rotation @ predicted + offset``.

    Attributes:
        rotation: (3, 3), orthonormal; a mirror has determinant -1.
        offset: (3,), m.
        misfit: median remaining distance, m.
    """

    rotation: np.ndarray
    offset: np.ndarray
    misfit: float

    @property
    def mirrored(self) -> bool:
        """Whether it includes a reflection."""
        return bool(np.linalg.det(self.rotation) < 0)

    @property
    def angle(self) -> float:
        """Angle of the rotation, rad."""
        return float(np.arccos(np.clip((np.trace(self.rotation) - 1) / 2, -1, 1)))


def align(predicted: np.ndarray, measured: np.ndarray, rotation: np.ndarray) -> Alignment:
    """The given rotation with its best (median) offset."""
    turned = predicted @ rotation.T
    offset = np.median(measured - turned, axis=0)
    return Alignment(rotation, offset, _misfit(measured - turned - offset))


def best_rotation(predicted: np.ndarray, measured: np.ndarray) -> Alignment:
    """Least squares over rotations, repeated without the worst points."""
    kept = np.ones(len(predicted), dtype=bool)
    for _ in range(4):
        rotation, offset = kabsch(predicted[kept], measured[kept], np.ones(int(kept.sum())))
        distance = np.linalg.norm(measured - predicted @ rotation.T - offset, axis=1)
        kept = distance <= max(4 * np.median(distance), 1e-12)
    return Alignment(rotation, offset, _misfit(measured - predicted @ rotation.T - offset))


def best_axes(predicted: np.ndarray, measured: np.ndarray) -> tuple[Alignment, str]:
    """Best of the 48 permutations and reflections of the axes, and its name like ``x,-z,y``."""
    fits = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            rotation = np.zeros((3, 3))
            rotation[range(3), order] = signs
            name = ",".join(
                ("-" if s < 0 else "") + "xyz"[k] for k, s in zip(order, signs, strict=True)
            )
            fits.append((align(predicted, measured, rotation), name))
    return min(fits, key=lambda pair: pair[0].misfit)


def _misfit(residual: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(residual, axis=1)))
