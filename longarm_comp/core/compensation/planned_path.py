"""A planned path: way-points of the tip, with joints and times, within limits.

The planned times stay if they keep the limits of velocity and acceleration. Else TOPP-RA (Pham
and Pham 2018, the library toppra) finds the fastest times that keep the limits and are nowhere
faster than the plan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.frame_tree import carry_place
from longarm_comp.core.arm.measuring import VISIBLE_M
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.model.model import Model
from longarm_comp.math.cubic_path import CubicPath, monotone_slopes, smooth_slopes

_LOOKED_AT = 16
"""Number of points per step between two way-points at which TOPP-RA checks the limits."""
_ROUNDING = 1e-6
"""Share by which a limit may be exceeded because of rounding."""


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """Way-points of the tip, and the joints and times of a planner; None: not planned.

    Each search starts from the planned joints.  Without times, the path is as fast as the limits
    allow.
    """

    targets: np.ndarray  # (k, 3) m or (k, 4, 4)
    times: np.ndarray | None = None  # (k,) s, increasing, 0 or later
    joints: np.ndarray | None = None  # (k, n) rad and m
    velocities: np.ndarray | None = None  # (k, n) rad/s and m/s
    begun: bool = False  # whether the planner believes the arm to stand at the first way-point

    @classmethod
    def of_joints(
        cls, arm: Arm, times: np.ndarray, joints: np.ndarray, velocities: np.ndarray | None = None
    ) -> PlannedPath:
        """Make the path of a joint trajectory: its targets are the declared, rigid arm's tip poses.

        The first way-point is where the planner believes the arm to stand.

        Args:
            times: (k,) s.
            joints: (k, n) rad and m.
            velocities: (k, n) rad/s and m/s; None: not planned.
        """
        return cls(Model(arm).pose(joints), times, joints, velocities, begun=True)

    def seen_from(self, base: np.ndarray) -> PlannedPath:
        """Return the plan with its targets in another frame.

        Args:
            base: (4, 4) pose of the present frame in the new one.
        """
        return replace(self, targets=carry_place(base, self.targets))

    def check(self, n: int) -> None:
        """Raise InputError if shapes or times are not allowed for an arm of n joints."""
        k = len(self.targets)
        if not k or self.targets.shape[1:] not in ((3,), (4, 4)):
            allowed = "(k, 3) or (k, 4, 4), k of at least 1"
            raise InputError("path", "targets", f"shape {self.targets.shape}", allowed)
        for name in ("joints", "velocities"):
            given = getattr(self, name)
            if given is not None and (given.shape != (k, n) or not np.isfinite(given).all()):
                raise InputError("path", name, f"shape {given.shape}", f"({k}, {n}), finite")
        if self.times is None:
            return
        if self.times.shape != (k,) or not np.isfinite(self.times).all():
            raise InputError("path", "times", f"shape {self.times.shape}", f"({k},), finite")
        late = (np.diff(self.times, prepend=-np.inf) > 0.0) & (self.times >= 0.0)
        for row in np.flatnonzero(~late)[:1]:
            now = float(self.times[row])
            raise InputError("path", f"time of way-point {row}", now, "0 s or later, rising")


def as_planned(
    rigid: Model, real: np.ndarray, q: np.ndarray, position_only: bool = False
) -> np.ndarray:
    """Find joints (n,) that bring the tip of the declared, rigid arm to a pose.

    The orientation is as near as the joints allow. If no joints inside the limits reach the
    position, the nearest ones are returned.

    Args:
        rigid: the model of the declared arm without effects.
        real: (4, 4) pose of the tip.
        q: (n,) joints near which the search starts.
        position_only: leave the orientation free.
    """
    found = ik.solve(rigid, real, seed=q, max_starts=1, position_only=position_only, near=True)
    return found.q


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """Largest velocity (rad/s, m/s) and acceleration (rad/s^2, m/s^2), (n,) each; inf: none."""

    velocity: np.ndarray
    acceleration: np.ndarray

    def excess(self, path: CubicPath) -> float:
        """Compute by which factor a path must be slower to keep all limits; at most 1 if it does.

        It is the largest of velocity / limit and of the square root of acceleration / limit.
        """
        speed = path.peak_velocity() / self.velocity
        force = path.peak_acceleration() / self.acceleration
        return float(max(speed.max(), np.sqrt(force.max())))


@dataclass(frozen=True, eq=False)
class PathLimits:
    """The limits of a path.

    Attributes:
        motion: limits of velocity and acceleration; None: the controller keeps them itself.
        max_turn_rad: largest error of the orientation where the joints cannot hold it.
        max_start: largest distance of a joint from where the plan begins, rad or m.
        turn_m: how far the tip may leave the path where a joint reverses, so that its play is
            taken up smoothly, m.
        max_longer: largest delay for taking up play, as a share of the planned duration; 0: planned
            times stay if the limits allow.
        position_only: leave the orientation free.
    """

    motion: MotionLimits | None = None
    max_turn_rad: float = 0.1
    max_start: float = np.inf
    turn_m: float = VISIBLE_M
    max_longer: float = 1.0
    position_only: bool = False


def retime(path: CubicPath, limits: MotionLimits) -> CubicPath:
    """Return the path with later times where a limit requires it; nowhere is it faster.

    Raises:
        JobError: no times keep the limits, or the library toppra is missing.
    """
    if limits.excess(path) <= 1.0 + _ROUNDING:
        return path
    begins = path.times[0]
    made = _find_times(replace(path, times=path.times - begins), limits)
    return replace(made, times=made.times + begins)


def find_fastest_way(joints: np.ndarray, limits: MotionLimits) -> CubicPath:
    """Find the fastest path through joints (k, n), rad and m, from rest to rest within limits."""
    ways = (np.abs(np.diff(joints, axis=0)) / limits.velocity).max(axis=1)  # s at full speed
    times = np.concatenate([[0.0], np.cumsum(np.maximum(ways, _ROUNDING * ways.sum()))])
    if not times[-1]:
        return CubicPath(_ROUNDING * np.arange(float(len(joints))), joints, np.zeros_like(joints))
    slopes = smooth_slopes(times, joints)  # of the geometric path, which is at rest nowhere
    slopes[[0, -1]] = np.diff(joints, axis=0)[[0, -1]] / np.diff(times)[[0, -1], None]
    path = CubicPath(times, joints, slopes)
    return replace(_find_times(path, limits), stretch=1.0)


def smooth(
    plan: PlannedPath,
    planned: np.ndarray,
    times: np.ndarray,
    stands: np.ndarray,
    beyond: np.ndarray,
    box: tuple[np.ndarray, np.ndarray],
) -> CubicPath:
    """Lay a smooth path through commands ``stands + beyond`` at times (k,), s.

    Args:
        plan: the planned path; its velocities are used if it has any.
        planned: (k,) s, the plan's own times.
        stands: (k, n) where the joints shall stand, rad and m.
        beyond: (k, n) by how much the commands go beyond, for instance to take up play.
        box: (n,) lowest and (n,) highest joints that may be sent, between way-points too.
    """
    joints = stands + beyond
    if len(joints) == 1:
        return CubicPath(times, joints, np.zeros_like(joints))
    slopes = monotone_slopes(times, beyond)
    if plan.velocities is None or plan.joints is None:
        slopes += smooth_slopes(times, stands)
    else:
        slopes += smooth_slopes(times, planned[:, None]) * plan.velocities
        slopes += smooth_slopes(times, stands - plan.joints)
    low, high = CubicPath(times, joints, slopes).extremes()
    out = (low < box[0]) | (high > box[1])
    slopes[:, out] = monotone_slopes(times, joints[:, out])
    return CubicPath(times, joints, slopes, float(np.ptp(times) / np.ptp(planned)))


def _find_times(path: CubicPath, limits: MotionLimits) -> CubicPath:
    """Return the path with the fastest times within limits, by TOPP-RA, from rest to rest.

    Nowhere is it faster than the path.
    """
    try:
        from toppra import algorithm, constraint
    except ImportError:
        raise JobError(
            "the path is faster than the limits, and toppra, which can slow it down, is missing: "
            "pip install 'longarm_comp[path]'"
        ) from None
    top = np.append(limits.velocity, 1.0)
    most = np.append(limits.acceleration, np.inf)
    between = constraint.DiscretizationType.Interpolation
    kept = [
        constraint.JointVelocityConstraint(np.stack([-top, top], 1)),
        constraint.JointAccelerationConstraint(np.stack([-most, most], 1), between),
    ]
    share = np.arange(_LOOKED_AT) / _LOOKED_AT
    grid = (path.times[:-1, None] + np.diff(path.times)[:, None] * share).ravel()
    grid = np.append(grid, path.times[-1])
    search = algorithm.TOPPRA(kept, _with_clock(path), gridpoints=grid)
    paces = search.compute_parameterization(0.0, 0.0)[1]
    if paces is None or not (np.asarray(paces, float)[1:-1] > 0.0).all():
        raise JobError("along the path the limits of velocity and acceleration cannot be kept")
    passed = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(grid) / (paces[1:] + paces[:-1]))])
    at = _LOOKED_AT * np.arange(len(path.times))
    stretch = path.stretch * float(passed[-1] / path.times[-1])
    slower = CubicPath(passed[at], path.joints, path.velocities * paces[at][:, None], stretch)
    over = max(1.0, limits.excess(slower))  # between way-points it is cubic in time again
    return CubicPath(slower.times * over, path.joints, slower.velocities / over, stretch * over)


def _with_clock(path: CubicPath) -> Any:
    """Return the path for toppra, with its own time as a further joint.

    The velocity limit of 1 of this joint keeps the path from becoming faster.
    """
    from toppra.interpolator import AbstractGeometricPath

    class Clocked(AbstractGeometricPath):  # type: ignore[misc]
        dof = path.joints.shape[1] + 1
        path_interval = np.array([path.times[0], path.times[-1]])

        def __call__(self, at: Any, order: int = 0) -> np.ndarray:
            times = np.asarray(at, float)
            clock = (times, np.ones_like(times), np.zeros_like(times))[order]
            return np.concatenate([path.at(times, order), clock[..., None]], axis=-1)

    return Clocked()
