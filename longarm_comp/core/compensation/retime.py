"""Times for a path through joint way-points, within limits of velocity and acceleration.

Where the planned times keep the limits they stay. Else TOPP-RA (Pham and Pham 2018, the library
toppra) finds the fastest times that keep them and are nowhere faster than the plan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from longarm_comp.core.errors import JobError

_LOOKED_AT = 16
"""Places between two way-points at which limits are looked at."""
_ROUNDING = 1e-6
"""Share of a limit that rounding may take."""


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """(n,) largest velocity (rad/s, m/s) and acceleration (rad/s^2, m/s^2); inf: none."""

    velocity: np.ndarray
    acceleration: np.ndarray

    @classmethod
    def none(cls, n: int) -> MotionLimits:
        """Of an arm of n joints whose controller keeps its limits itself."""
        return cls(np.full(n, np.inf), np.full(n, np.inf))

    @property
    def bounded(self) -> bool:
        """Whether every joint has both."""
        return bool(np.isfinite(self.velocity).all() and np.isfinite(self.acceleration).all())


@dataclass(frozen=True, eq=False)
class Timed:
    """Cubic Hermite segments from rest to rest, as joint trajectory controllers follow them.

    Attributes:
        times: (k,) s, increasing. joints, velocities: (k, n) at these times.
        stretch: by what the plan's duration was multiplied; 1 where its times stayed.
    """

    times: np.ndarray
    joints: np.ndarray
    velocities: np.ndarray
    stretch: float = 1.0

    def at(self, times: np.ndarray, order: int = 0) -> np.ndarray:
        """(N, n) joints at some times, or their derivative of an order."""
        found: np.ndarray = self._spline(times, order)
        return found

    @property
    def _spline(self) -> CubicHermiteSpline:
        return CubicHermiteSpline(self.times, self.joints, self.velocities)

    @property
    def between(self) -> np.ndarray:
        """Times at which limits are looked at: 16 in every segment, and its ends from inside."""
        share = np.linspace(1e-9, 1.0 - 1e-9, _LOOKED_AT)
        return (self.times[:-1, None] + np.diff(self.times)[:, None] * share).ravel()

    def excess(self, limits: MotionLimits) -> float:
        """The largest share of a limit that velocity, or root of acceleration, takes."""
        times = self.between
        speed = np.abs(self.at(times, 1)) / limits.velocity
        force = np.abs(self.at(times, 2)) / limits.acceleration
        return float(max(speed.max(initial=0.0), np.sqrt(force.max(initial=0.0))))


def slopes_of(times: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """(k, n) velocities at way-points (k, n), monotone between them and 0 at both ends."""
    slopes = np.zeros_like(joints)
    if len(times) > 2:
        slopes[1:-1] = PchipInterpolator(times, joints).derivative()(times[1:-1])
    return slopes


def retimed(path: Timed, limits: MotionLimits) -> Timed:
    """The path within limits, at the same way-points and nowhere faster. It begins at time 0."""
    if path.excess(limits) <= 1.0 + _ROUNDING:
        return path
    return _found(path, limits)


def fastest(joints: np.ndarray, limits: MotionLimits) -> Timed:
    """The fastest way through way-points (k, n) from rest to rest."""
    ways = (np.abs(np.diff(joints, axis=0)) / limits.velocity).max(axis=1)  # s at full speed
    times = np.concatenate([[0.0], np.cumsum(np.maximum(ways, _ROUNDING * ways.sum()))])
    if not times[-1]:
        return Timed(_ROUNDING * np.arange(len(joints)), joints, np.zeros_like(joints))
    path = Timed(times, joints, PchipInterpolator(times, joints).derivative()(times))
    return replace(_found(path, limits), stretch=1.0)


def planned_times(
    times: np.ndarray | None,
    joints: np.ndarray,
    limits: MotionLimits,
    planned: np.ndarray | None,
    velocities: np.ndarray | None,
    later_s: float = 0.0,
) -> Timed:
    """Way-points (k, n) at planned times (k,), or later where limits demand it.

    Without times as fast as the limits allow; without these too, a second a way-point.

    Args:
        planned, velocities: (k, n) of the plan that the way-points correct.
        later_s: by so much the first way lasts longer, and is gone more slowly.
    """
    first = 0.0 if times is None else float(times[0])
    if len(joints) == 1:
        return Timed(np.array([first]), joints, np.zeros_like(joints))
    if times is None and limits.bounded:
        return fastest(joints, limits)
    since = np.arange(float(len(joints))) if times is None else times - first
    first_s, whole_s = float(since[1]), float(since[-1])
    since = np.append(0.0, since[1:] + later_s)
    slopes = slopes_of(since, joints)
    if velocities is not None and planned is not None:
        slopes = slopes_of(since, joints - planned) + velocities
        slopes[1] -= velocities[1] * later_s / (first_s + later_s)
        slopes[[0, -1]] = 0.0
    made = retimed(Timed(since, joints, slopes, since[-1] / whole_s), limits)
    return replace(made, times=made.times + first)


def _found(path: Timed, limits: MotionLimits) -> Timed:
    """Times by TOPP-RA, from rest to rest."""
    try:
        from toppra import algorithm, constraint
    except ImportError:
        raise JobError(
            "the path is faster than the limits and toppra is not there to slow it down: "
            "pip install 'longarm_comp[path]'"
        ) from None
    top = np.append(limits.velocity, 1.0)
    most = np.append(limits.acceleration, np.inf)
    top, most = (np.where(np.isfinite(each), each, _HUGE) for each in (top, most))
    kept = [
        constraint.JointVelocityConstraint(np.stack([-top, top], 1)),
        constraint.JointAccelerationConstraint(
            np.stack([-most, most], 1), constraint.DiscretizationType.Interpolation
        ),
    ]
    share = np.arange(_LOOKED_AT) / _LOOKED_AT
    grid = (path.times[:-1, None] + np.diff(path.times)[:, None] * share).ravel()
    grid = np.append(grid, path.times[-1])
    search = algorithm.TOPPRA(kept, _with_clock(path), gridpoints=grid)
    paces = search.compute_parameterization(0.0, 0.0)[1]
    if paces is None or not (np.asarray(paces, float)[1:-1] > 0.0).all():
        raise JobError("no times keep the limits of velocity and acceleration along the path")
    passed = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(grid) / (paces[1:] + paces[:-1]))])
    at = _LOOKED_AT * np.arange(len(path.times))
    stretch = path.stretch * float(passed[-1] / path.times[-1])
    slower = Timed(passed[at], path.joints, path.velocities * paces[at][:, None], stretch)
    over = max(1.0, slower.excess(limits))  # between way-points it is cubic in time again
    return Timed(slower.times * over, path.joints, slower.velocities / over, stretch * over)


_HUGE = 1e9
"""Stands for no limit: rad/s, m/s and their rates."""


def _with_clock(path: Timed) -> Any:
    """The path with the plan's own time as one joint more: its limit of 1 keeps the plan's pace."""
    from toppra.interpolator import AbstractGeometricPath

    class Clocked(AbstractGeometricPath):  # type: ignore[misc]
        dof = path.joints.shape[1] + 1
        path_interval = np.array([path.times[0], path.times[-1]])

        def __call__(self, at: Any, order: int = 0) -> np.ndarray:
            times = np.asarray(at, float)
            clock = (times, np.ones_like(times), np.zeros_like(times))[order]
            return np.concatenate([path.at(times, order), clock[..., None]], axis=-1)

    return Clocked()
