"""Joints along a path that is cubic in time between way-points (Hermite segments)."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
STRAIGHT = 1e-3
"""Distance from a straight line at which joints still count as on it, rad or m."""


@dataclass(frozen=True, eq=False)
class CubicPath:
    """Cubic Hermite segments, as joint trajectory controllers follow them."""

    times: Array  # (k,) s, increasing
    joints: Array  # (k, n) rad or m at these times
    velocities: Array  # (k, n) rad/s or m/s at these times
    stretch: float = 1.0
    """Factor by which the duration was multiplied to keep limits, or to take up play."""

    def at(self, time_s: npt.ArrayLike, order: int = 0) -> Array:
        """Return the joints (..., n) at times (...), s, or their derivative of an order up to 3.

        Before and after the path they are those at its ends.
        """
        t = np.clip(time_s, self.times[0], self.times[-1])[..., None]
        k = np.searchsorted(self.times[1:-1], t[..., 0], side="right")
        if len(self.times) == 1:
            return self.joints[k] if not order else np.zeros_like(self.joints[k])
        h = (self.times[k + 1] - self.times[k])[..., None]
        u = (t - self.times[k][..., None]) / h
        m, n = h * self.velocities[k], h * self.velocities[k + 1]
        way = self.joints[k + 1] - self.joints[k]
        bend, twist = 3.0 * way - 2.0 * m - n, m + n - 2.0 * way
        if order == 0:
            return self.joints[k] + (m + (bend + twist * u) * u) * u
        slopes = (m + (2.0 * bend + 3.0 * twist * u) * u, 2.0 * bend + 6.0 * twist * u, 6.0 * twist)
        return np.asarray(np.broadcast_to(slopes[order - 1] / h**order, way.shape))

    @property
    def duration(self) -> float:
        """The time from 0 s to its end, s."""
        return float(self.times[-1])

    @property
    def end(self) -> Array:
        """The joints (n,) at its end, rad or m."""
        return self.joints[-1]

    def extremes(self) -> tuple[Array, Array]:
        """Return the lowest and the highest joints on the path, (n,) each, rad or m."""
        h = np.diff(self.times)[:, None]
        b, c = self._velocity_terms()
        m = self.velocities[:-1]
        # Turning points: m + b u + c u^2 = 0 with the stable form of the quadratic formula.
        root = np.sqrt(np.maximum(b**2 - 4 * c * m, 0.0))
        half = -0.5 * (b + np.where(b < 0, -root, root))
        with np.errstate(divide="ignore", invalid="ignore"):
            turns = np.stack((half / c, m / half))
        turns = np.clip(np.where(np.isfinite(turns), turns, 0.0), 0.0, 1.0)
        reached = self.joints[:-1] + h * (m * turns + b * turns**2 / 2 + c * turns**3 / 3)
        every = np.concatenate([self.joints, *reached])
        return every.min(axis=0), every.max(axis=0)

    def peak_velocity(self) -> Array:
        """Return each joint's highest speed on the path, (n,) rad/s or m/s."""
        b, c = self._velocity_terms()
        m = self.velocities[:-1]
        with np.errstate(divide="ignore", invalid="ignore"):
            u = -b / (2 * c)
        u = np.where((u > 0.0) & (u < 1.0), u, 0.0)
        inner = m + b * u + c * u**2
        return np.abs(np.concatenate((self.velocities, inner))).max(axis=0)

    def peak_acceleration(self) -> Array:
        """Return the peak acceleration, (n,): at an end of a segment, as it is linear within."""
        (b, c), h = self._velocity_terms(), np.diff(self.times)[:, None]
        ends = np.maximum(np.abs(b), np.abs(b + 2.0 * c)) / h
        return np.asarray(ends.max(axis=0, initial=0.0))

    def chords(self, off: float) -> Array:
        """Return times (M,), s, between which every joint is within ``off`` of a straight line.

        The times of all way-points are among them.
        """
        (b, c), h = self._velocity_terms(), np.diff(self.times)
        bend = h * np.maximum(np.abs(b), np.abs(b + 2.0 * c)).max(axis=1)
        at = split(np.ceil(np.sqrt(np.maximum(bend / (8.0 * off), 1.0))).astype(int))
        return np.interp(at, np.arange(len(self.times)), self.times)

    @property
    def jerk(self) -> Array:
        """The jerk of every segment, (k - 1, n) rad/s^3 or m/s^3."""
        return 2.0 * self._velocity_terms()[1] / np.diff(self.times)[:, None] ** 2

    def mean_square_jerk(self, unit: Array) -> float:
        """Return the squared jerk of all joints together, in units (n,), averaged over time."""
        if len(self.times) == 1:
            return 0.0
        square = ((self.jerk / unit) ** 2).sum(axis=1)
        return float(np.average(square, weights=np.diff(self.times)))

    def _velocity_terms(self) -> tuple[Array, Array]:
        """Return b, c of the velocity in each segment, ``slope + b u + c u^2``, u from 0 to 1."""
        chord = np.diff(self.joints, axis=0) / np.diff(self.times)[:, None]
        m, n = self.velocities[:-1], self.velocities[1:]
        return 6 * chord - 4 * m - 2 * n, 3 * (m + n) - 6 * chord


def split(pieces: np.ndarray) -> Array:
    """Divide intervals of length 1 into numbers of equal pieces; return the ends of all pieces.

    They are (sum(pieces) + 1,), from 0; 1.5 is the middle of the second interval.
    """
    k = np.repeat(np.arange(len(pieces)), pieces)
    begun = np.repeat(np.cumsum(pieces) - pieces, pieces)
    return np.append(k + (np.arange(len(k)) - begun) / pieces[k], float(len(pieces)))


def smooth_slopes(times: Array, joints: Array) -> Array:
    """Return velocities (k, n) at way-points (k, n), 0 at both ends.

    They are the slopes of parabolas through three way-points, plus two thirds of the correction
    that one round of a cubic spline's equations gives: then errors of third order cancel. They are
    accurate to fourth order in the time steps where these change slowly.
    """
    slopes = np.zeros_like(joints)
    if len(times) < 3:
        return slopes
    h = np.diff(times)[:, None]
    chord = np.diff(joints, axis=0) / h
    left = h[1:] / (h[1:] + h[:-1])
    inner = left * chord[:-1] + (1.0 - left) * chord[1:]
    slopes[1:-1] = inner
    beside = left * slopes[:-2] + (1.0 - left) * slopes[2:]
    slopes[1:-1] = (4.0 * inner - beside) / 3.0
    return slopes


def monotone_slopes(times: Array, joints: Array) -> Array:
    """Return `smooth_slopes` reduced so that the path stays in the box of its way-points.

    They are 0 wherever a joint reverses, and at most three times the smaller mean velocity of the
    two segments beside them (Fritsch and Carlson 1980).
    """
    slopes = smooth_slopes(times, joints)
    if len(times) > 2:
        chord = np.diff(joints, axis=0) / np.diff(times)[:, None]
        before, after = chord[:-1], chord[1:]
        side = np.sign(before) * (before * after > 0.0)
        most = 3.0 * np.minimum(np.abs(before), np.abs(after))
        slopes[1:-1] = side * np.clip(side * slopes[1:-1], 0.0, most)
    return slopes
