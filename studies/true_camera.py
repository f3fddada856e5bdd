"""A stereo head that sees the true arm: its errors, by chance and hidden ones, by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import State, TrueContext
from longarm_comp.sim.hidden import catalogue
from longarm_comp.sim.hidden.base import Dosed, HiddenEffect
from longarm_comp.sim.rods import STEPS, rpy_matrix

Array = np.ndarray


class CameraEffect(Dosed):
    """Moves the seen point, not the arm. Points are in camera axes: x right, y down, z depth."""

    def seen(self, points: Array, t_s: Array) -> Array:
        """Return seen points (N, 3) m of true points (N, 3) m at times (N,) s."""
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
        """Return errors (N, 3) m for lines of sight (N, 3)."""
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
        """Return the declared head of an arm, upright."""
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
        """Report true points (N, 3) m without noise, (N, 3) m, with measuring-side effects."""
        t = np.broadcast_to(t_s, len(points)).astype(float)
        local = (points - self.position_m) @ self.axes.T
        for effect in self.effects:
            local = effect.seen(local, t)
        return local @ self.axes + self.position_m

    def sight(self, points: Array) -> Array:
        """Return unit line of sight to each point, (N, 3)."""
        line = points - self.position_m
        return line / np.linalg.norm(line, axis=1, keepdims=True)


Hidden = HiddenEffect | CameraEffect


def make_truth(
    arm: Arm, effects: Sequence[Hidden], steps: int = STEPS
) -> tuple[TrueArm, TrueCamera]:
    """Return the arm and the head that sees it, each with the effects of its side, in order.

    Args:
        steps: of the rods, as in `TrueArm`.
    """
    on_arm = [e for e in effects if isinstance(e, HiddenEffect)]
    seeing = [e for e in effects if isinstance(e, CameraEffect)]
    return TrueArm(arm, on_arm, steps=steps), TrueCamera.of(arm, seeing)


def draw_geometry_errors(arm: Arm, dose: float, rng: np.random.Generator) -> list[HiddenEffect]:
    """Draw errors of joint zeros, of rows and of the base, `dose` times their typical size."""
    names = ("joint_zero", "dh_error", "base_pose")
    return [catalogue.hidden(name, arm, dose, rng) for name in names]


HIDDEN: dict[str, Callable[[Arm, np.random.Generator], Hidden]] = {
    **catalogue.HIDDEN,
    "camera_pose": lambda arm, rng: CameraPose(rng.standard_normal(6) * ([2e-3] * 3 + [2e-3] * 3)),
    "camera_scale": lambda arm, rng: CameraScale(float(rng.choice([-3e-3, 3e-3]))),
    "camera_radial": lambda arm, rng: CameraRadial(rng.uniform(0.02, 0.06)),
    "camera_drift": lambda arm, rng: CameraDrift(
        rng.standard_normal(6) * ([1e-3] * 3 + [1e-4] * 3)
    ),
}
"""Hidden effects of the arm, and of its cameras."""


def hidden(name: str, arm: Arm, dose: float, rng: np.random.Generator) -> Hidden:
    """Return an effect by name, `dose` times its typical size, at a random place."""
    if name not in HIDDEN:
        raise InputError("hidden effect", "name", name, ", ".join(HIDDEN))
    made: Hidden = HIDDEN[name](arm, rng).scale_by(dose)
    return made


def draw(
    name: str, arm: Arm, rng: np.random.Generator, size_mm: float, poses: Array | None = None
) -> Hidden:
    """Draw as `catalogue.draw` does, of the cameras' side too."""
    made: Hidden = catalogue.scale_to_size(
        hidden(name, arm, 1.0, rng), arm, rng, size_mm, poses, seen_tip
    )
    return made


def seen_tip(effect: Hidden, arm: Arm, poses: Array, context: TrueContext, sound: Array) -> Array:
    """Return seen tip (N, 3) with one effect; `sound` is the tip without it."""
    if isinstance(effect, CameraEffect):
        return TrueCamera.of(arm, [effect]).seen(sound, State.of(arm, poses, context).t_s)
    return catalogue.moved_tip(effect, arm, poses, context, sound)
