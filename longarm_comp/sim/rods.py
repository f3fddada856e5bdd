"""Exact elastic rods, integrated from the tip back to the base.

Kirchhoff rods (bending and torsion; optionally Cosserat rods, with shear and extension) under
weight alone.  A `Walker` is at a section of the chain and holds the state of everything *beyond* it
in the section's own axes: gravity, the moment of the weight beyond, points and directions.  One
step back by ``du`` along the rod's axis ``e`` turns the axes by ``kappa du``, so that

    d gamma / du = kappa x gamma
    d mu / du    = kappa x mu + e x (M gamma)        kappa = diag(compliance) mu
    d point / du = kappa x point + e
    d M / du     = density

(Antman, *Nonlinear Problems of Elasticity*, ch. 8, written in the section's axes).  Nothing
is linearised; every load acts at its place on the bent rod.  The only unknown is the direction of
gravity in the axes of the last frame, two angles.  They are found by shooting until gravity points
down in the base frame (`settle`).
"""

from collections.abc import Callable, Sequence

import numpy as np

from longarm_comp.core.errors import JobError

Array = np.ndarray
STEPS, QUICK_STEPS = 4, 2
"""Integration steps of a piece of rod: 1 and 10 nm at the tip of an arm that sags by 20 mm."""
_GRAVITY, _MOMENT = 0, 1
_CONVERGED = 3e-7  # rad, of gravity's direction in the base frame, before the last Newton step


class Walker:
    """State of everything beyond one section of the chain, in the section's axes.

    Args:
        gamma: gravity in the axes of the last frame, (3, B, N) m/s^2: N postures, B trial
            directions each.

    Attributes:
        mass: carried mass, kg, broadcast against (B, N).
    """

    def __init__(self, gamma: Array) -> None:
        self._v = np.zeros((3, 2, *gamma.shape[1:]))  # component, vector, trial, posture
        self._v[:, _GRAVITY] = gamma
        self._point = np.zeros(2)
        self.mass: Array | float = 0.0
        self._pushed: int | None = None

    @property
    def gravity(self) -> Array:
        """Gravity here, (3, B, N) m/s^2."""
        return self._v[:, _GRAVITY]

    @property
    def moment(self) -> Array:
        """Moment about this section of all forces beyond it, (3, B, N) N m."""
        return self._v[:, _MOMENT]

    @property
    def force(self) -> Array:
        """Force of everything beyond this section, (3, B, N), N: weight and applied forces."""
        return self._add_force(self._v, self.mass)

    def _add_force(self, v: Array, mass: Array | float) -> Array:
        weight = mass * v[:, _GRAVITY]
        return weight if self._pushed is None else weight + v[:, 2 + self._pushed]

    def get_mark(self, index: int) -> Array:
        """Return the marked point or direction number `index` in the present axes, (3, B, N)."""
        return self._v[:, 2 + index]

    def mark(self, vector: Sequence[float] | Array, *, point: bool) -> int:
        """Follow a point (m) or direction `vector` (3,) from here on; return its number."""
        new = np.empty((3, 1, *self._v.shape[2:]))
        new[:] = np.reshape(vector, (3, 1, 1, 1))
        self._v = np.concatenate([self._v, new], axis=1)
        self._point = np.append(self._point, float(point))
        return len(self._point) - 3

    def hang(self, mass: Array | float, at: Sequence[float] | Array) -> None:
        """Add a mass (kg) at a position (m) in these axes."""
        self._v[:, _MOMENT] += cross(_as_column(at), mass * self.gravity)
        self.mass = self.mass + mass

    def push(self, force: Array, at: Sequence[float] | Array) -> None:
        """Apply a force (3, N), N, at a position (m), both along the walker's present axes."""
        if self._pushed is None:
            self._pushed = self.mark((0.0, 0.0, 0.0), point=False)
        applied = _as_column(force)
        self._v[:, 2 + self._pushed] += applied
        self._v[:, _MOMENT] += cross(_as_column(at), applied + 0 * self.gravity)

    def shift(self, offset: Array) -> None:
        """Go back along a rigid piece, (3, ...) m from the new section to this one."""
        v = _as_column(offset)
        self._v[:, _MOMENT] += cross(v, self.force)
        self._v += v[:, None] * self._point[:, None, None]

    def turn(self, axis: int, angle: Array | float) -> None:
        """Go back through a rotation by `angle` (rad) about coordinate axis 0, 1 or 2."""
        c, s = np.cos(angle), np.sin(angle)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        vi, vj = self._v[i].copy(), self._v[j].copy()
        self._v[i] = c * vi - s * vj
        self._v[j] = s * vi + c * vj

    def rotate(self, matrix: Array) -> None:
        """Go back through a rotation matrix, (3, 3) or (3, 3, N)."""
        self._v = np.stack([sum(matrix[i, k] * self._v[k] for k in range(3)) for i in range(3)])

    def give(self, vector: Array) -> None:
        """Go back through a rotation by a rotation vector (3, B, N), rad."""
        w = vector[:, None]
        angle2 = np.sum(w * w, axis=0)
        angle = np.sqrt(angle2)
        tiny = angle < 1e-4
        safe = np.where(tiny, 1.0, angle)
        a = np.where(tiny, 1 - angle2 / 6, np.sin(safe) / safe)
        b = np.where(tiny, 0.5 - angle2 / 24, (1 - np.cos(safe)) / safe**2)
        wv = cross(w, self._v)
        self._v = self._v + a * wv + b * cross(w, wv)

    def rod(
        self,
        axis: int,
        sign: float,
        length: Array,
        compliance: Array,
        density: Array | float,
        steps: int = STEPS,
        stretch: Array | None = None,
    ) -> None:
        """Go back along an elastic rod (classical Runge-Kutta).

        Args:
            axis: 0 or 2, the coordinate axis that the unloaded rod lies along.
            sign: +1 or -1, the rod's direction on that axis.
            length: (N,) m.
            compliance: 1/(EI, EI, GJ) in the order of the axes, (3,) or (3, N), 1/(N m^2).
            density: mass per length, kg/m, scalar or (N,).
            steps: integration steps.
            stretch: 1/(kGA, kGA, EA) in the order of the axes, (3,), 1/N: shear and extension;
                None leaves them out.
        """
        c = np.reshape(compliance, (3, 1, -1))
        h = length / steps

        def rate(v: Array, mass: Array | float) -> Array:
            kappa = c * v[:, _MOMENT]
            out = cross(kappa[:, None], v)
            f = self._add_force(v, mass)
            i, j = (axis + 1) % 3, (axis + 2) % 3
            out[i, _MOMENT] -= sign * f[j]
            out[j, _MOMENT] += sign * f[i]
            out[axis] += sign * self._point[:, None, None]
            if stretch is not None:
                strain = np.reshape(stretch, (3, 1, 1)) * f
                out += strain[:, None] * self._point[:, None, None]
                out[:, _MOMENT] += cross(strain, f)
            return out

        v, mass = self._v, self.mass
        for _ in range(steps):
            middle, end = mass + density * (h / 2), mass + density * h
            k1 = rate(v, mass)
            k2 = rate(v + (h / 2) * k1, middle)
            k3 = rate(v + (h / 2) * k2, middle)
            k4 = rate(v + h * k3, end)
            v = v + (h / 6) * (k1 + 2 * (k2 + k3) + k4)
            mass = end
        self._v, self.mass = v, mass


def settle(walk: Callable[[Array], Walker], start: Array, gravity: Array) -> Array:
    """Return the gravity in the last frame's axes for which it is `gravity` in the base frame.

    Newton's method on the two angles of the direction, for all postures at once. If the full load
    does not converge, it is raised in steps.

    Args:
        start: first guess, (3, N), of gravity's length.

    Returns:
        (3, N) m/s^2.

    Raises:
        JobError: Newton's method does not converge.
    """
    size = float(np.linalg.norm(gravity))
    if size == 0.0:
        return np.zeros_like(start)
    left = np.inf
    for parts in (1, 4, 16, 64):
        unit = start / size
        for part in range(1, parts + 1):
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                unit, left = _solve_directions(walk, unit, gravity / size, size * part / parts)
        if left < _CONVERGED:
            return size * unit
    raise JobError("the rods found no equilibrium", left_rad=left, postures=start.shape[1])


def _solve_directions(
    walk: Callable[[Array], Walker], unit: Array, down: Array, size: float
) -> tuple[Array, float]:
    """Return directions (3, N) and the largest angle left (rad)."""
    first, second = _find_normals(down[:, None])
    step, left = 1e-6, np.inf
    for _ in range(12):  # Newton steps
        t1, t2 = _find_normals(unit)
        trials = np.stack([unit, unit + step * t1, unit + step * t2], axis=1)
        found = walk(size * trials).gravity / size
        r = np.stack([np.sum(first[:, None] * found, 0), np.sum(second[:, None] * found, 0)])
        wrong = np.sum(down[:, None] * found[:, 0], 0) < 0
        angle = np.where(wrong, np.pi, np.hypot(r[0, 0], r[1, 0]))
        left = float(np.max(angle, initial=0.0))
        (a, b), (c, d) = (r[0, 1:] - r[0, 0]) / step, (r[1, 1:] - r[1, 0]) / step
        det = a * d - b * c
        x = (-d * r[0, 0] + b * r[1, 0]) / det
        y = (c * r[0, 0] - a * r[1, 0]) / det
        limit = np.minimum(1.0, 0.5 / np.maximum(np.hypot(x, y), 1e-30))
        unit = unit + limit * (x * t1 + y * t2)
        unit = unit / np.sqrt(np.sum(unit * unit, axis=0))
        if not np.all(np.isfinite(unit)):
            return unit, np.inf
        if left < _CONVERGED:
            break
    return unit, left


def cross(a: Array, b: Array) -> Array:
    """Return the cross product over the first axis."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return out


def rpy_matrix(rpy: Sequence[float] | Array) -> Array:
    """Return the rotation matrix (3, 3) of fixed-axis roll, pitch, yaw (rad)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return rz @ ry @ rx


def _find_normals(unit: Array) -> tuple[Array, Array]:
    """Return two unit vectors normal to each unit vector (3, N) and to each other."""
    pick = np.where(np.abs(unit[0]) < 0.6, 0, 1)
    other = np.stack([pick == 0, pick == 1, np.zeros_like(pick, bool)]).astype(float)
    first = cross(unit, other)
    first = first / np.sqrt(np.sum(first * first, axis=0))
    return first, cross(unit, first)


def _as_column(vector: Sequence[float] | Array) -> Array:
    """Return a vector, or (3, N), or (3, B, N), as (3, B, N)."""
    v = np.asarray(vector, float)
    return v.reshape(3, *([1] * (3 - v.ndim)), *v.shape[1:])
