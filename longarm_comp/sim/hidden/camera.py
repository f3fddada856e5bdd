"""Hidden effects on the measuring side: errors of the points reported by the stereo head."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.sim.hidden.base import Dosed
from longarm_comp.sim.rods import rpy_matrix

Array = np.ndarray


class CameraEffect(Dosed):
    """Moves the seen point, not the arm. Points are in camera axes: x right, y down, z depth."""

    def seen(self, points: Array, t_s: Array) -> Array:
        """Seen points (N, 3) m of true points (N, 3) m at times (N,) s."""
        raise NotImplementedError


@dataclass(frozen=True)
class CameraPose(CameraEffect):
    """Pose error `delta` (6,) of the head: m and rad, in camera axes."""

    delta: Array

    def seen(self, points: Array, t_s: Array) -> Array:
        return (points - self.delta[:3]) @ rpy_matrix(self.delta[3:])


@dataclass(frozen=True)
class CameraScale(CameraEffect):
    """Baseline error: seen distances are 1 + scale times the true ones."""

    scale: float

    def seen(self, points: Array, t_s: Array) -> Array:
        return points * (1 + self.scale)


@dataclass(frozen=True)
class CameraRadial(CameraEffect):
    """Remaining lens distortion: factor 1 + k1 (x^2 + y^2) / z^2 across the optical axis."""

    k1: float

    def seen(self, points: Array, t_s: Array) -> Array:
        r2 = (points[:, 0] ** 2 + points[:, 1] ** 2) / points[:, 2] ** 2
        out = points.copy()
        out[:, :2] *= (1 + self.k1 * r2)[:, None]
        return out


@dataclass(frozen=True)
class CameraDrift(CameraEffect):
    """The head's mount moves with time: `rate` (6,) m/h and rad/h, in camera axes."""

    rate: Array

    def seen(self, points: Array, t_s: Array) -> Array:
        hours = t_s[:, None] / 3600
        return points - hours * self.rate[:3] - np.cross(hours * self.rate[3:], points)
