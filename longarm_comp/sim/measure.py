"""What the stereo head sees of the true arm: its errors, systematic and by chance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.sim.hidden.camera import CameraEffect

Array = np.ndarray


@dataclass(frozen=True)
class Noise:
    """Random errors of a sighting.

    Attributes:
        sigma_m: equal in all directions.
        depth_m: additional error along the line of sight.
        rho: correlation from one row to the next (AR(1)).
        tail_dof: degrees of freedom of Student's t, scaled to the same variance; None: normal.
    """

    sigma_m: float = 0.22e-3
    depth_m: float = 0.28e-3
    rho: float = 0.0
    tail_dof: float | None = None

    def draw(self, sight: Array, rng: np.random.Generator) -> Array:
        """Errors (N, 3) m for lines of sight (N, 3)."""
        raw = self.sigma_m * self._unit((len(sight), 3), rng)
        raw += self.depth_m * self._unit((len(sight), 1), rng) * sight
        for k in range(1, len(raw)):
            raw[k] = self.rho * raw[k - 1] + np.sqrt(1 - self.rho**2) * raw[k]
        return raw

    def _unit(self, shape: tuple[int, int], rng: np.random.Generator) -> Array:
        if self.tail_dof is None:
            return rng.standard_normal(shape)
        return rng.standard_t(self.tail_dof, shape) * np.sqrt((self.tail_dof - 2) / self.tail_dof)


@dataclass(frozen=True)
class TrueCamera:
    """A stereo head that reports points in the base frame.

    Attributes:
        position_m: (3,) in the base frame.
        axes: rows are its axes x right, y down, z along the optical axis, in the base frame.
        effects: measuring-side errors, in order.
    """

    position_m: Array
    axes: Array
    effects: tuple[CameraEffect, ...] = ()

    @classmethod
    def of(cls, arm: Arm, effects: Sequence[CameraEffect] = ()) -> TrueCamera:
        """The declared head of an arm, upright."""
        if arm.camera is None:
            raise InputError(arm.name, "camera", "missing", "position_m and optical_axis")
        z = np.asarray(arm.camera.optical_axis, float)
        z = z / np.linalg.norm(z)
        x = np.cross(z, (0.0, 0.0, 1.0))
        if np.linalg.norm(x) < 1e-6:
            raise InputError(arm.name, "camera.optical_axis", z, "a direction off the vertical")
        x = x / np.linalg.norm(x)
        axes = np.stack([x, np.cross(z, x), z])
        return cls(np.asarray(arm.camera.position_m, float), axes, tuple(effects))

    def seen(self, points: Array, t_s: Array | float = 0.0) -> Array:
        """Noise-free report (N, 3) m of true points (N, 3) m, measuring-side effects included."""
        t = np.broadcast_to(t_s, len(points)).astype(float)
        local = (points - self.position_m) @ self.axes.T
        for effect in self.effects:
            local = effect.seen(local, t)
        return local @ self.axes + self.position_m

    def sight(self, points: Array) -> Array:
        """Unit line of sight to each point, (N, 3)."""
        line = points - self.position_m
        return line / np.linalg.norm(line, axis=1, keepdims=True)
