"""The true arm's vibration: rigid segments joined by springs, driven by the motion of the joints.

Every rod is cut into rigid pieces with a rotational spring in the middle of each; a compliance at a
bearing is a spring there (the finite segment method: Huston, *Multibody Dynamics*, 1990).  A spring
has the stiffness of the hidden effects beyond their play.  The vibration is small, about the unbent
arm.
"""

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.errors import InputError
from longarm_comp.sim.arm_truth import TrueArm, Walk
from longarm_comp.sim.context import Array, State
from longarm_comp.sim.hidden.base import THETA, A, D, Place
from longarm_comp.sim.rods import Walker, rpy_matrix

PIECES = 6
"""Pieces of each rod: frequencies of eight modes are right to 1 %, of the two lowest to 0.03 %."""
MODES = 8
"""Number of modes, the slowest ones: those of the demonstration's arm are 5 to 140 Hz."""


@dataclass(frozen=True, eq=False)
class _Vibration:
    """Modes about one posture, scaled to a modal mass of 1 kg."""

    omega: Array  # (k,) rad/s. shape: (3 P, k) of all masses. mass: (3 P,) kg. tip: (3, k).
    shape: Array
    mass: Array
    tip: Array
    carried: Array  # (3 P, n) motion of all masses by a unit of each joint, the springs held
    driven: Array  # (k, n) by a unit of each joint's acceleration
    turned: Array  # (n, k) turn of the spring at each joint's bearing; an encoder there sees it


class _Build:
    """Springs and masses, from the foot to the tip."""

    def __init__(self, true: TrueArm, q: Array) -> None:
        self.arm, self._hidden = true.arm, true.hidden
        self._state = State.of(self.arm, np.tile(q, (3, 1)), None)
        self._walk = Walk(true, self._state)
        self.springs: list[tuple[Array, Array]] = []  # where, and root of its compliance
        self.masses: list[tuple[Array, float, int]] = []  # where, kg, springs before it
        self.moved: list[tuple[Array, Array | None, Array, int]] = []  # rows that move
        self.bearings: dict[int, tuple[int, Array]] = {}  # spring and axis, by joint
        self._turn, self._at = rpy_matrix(self._walk.base[3:]), self._walk.base[:3]
        self.tip = (self._at, 0)
        self._add_yielding(Place("base", 0))
        self._add_frame(0)
        for row in range(1, len(self.arm.joints) + 1):
            self._add_row(row)

    def _add_yielding(self, place: Place) -> None:
        """Add a spring where hidden effects yield."""
        whole = np.zeros((3, 3))
        for effect in self._hidden:
            gives = []
            for times in (1.0, 2.0):
                walker = Walker(np.zeros((3, 1, 3)))
                walker.moment[:, 0] = times * np.eye(3)  # moments about the three axes here
                gives.append(effect.give(place, walker, self._state))
            if gives[0] is not None and gives[1] is not None:
                whole += (gives[1] - gives[0])[:, 0]
        if whole.any():
            self._add_spring(self._at, whole)

    def _add_spring(self, at: Array, compliance: Array) -> None:
        values, axes = np.linalg.eigh(0.5 * (compliance + compliance.T))
        root = self._turn @ (axes * np.sqrt(np.maximum(values, 0.0)))
        self.springs.append((np.array(at), root))

    def _add_frame(self, row: int) -> None:
        for mass, at in self._walk.masses[row]:
            self._add_mass(float(np.ravel(mass)[0]), self._at + self._turn @ np.asarray(at))
        if row == self.arm.tip.frame:
            self.tip = (
                self._at + self._turn @ np.asarray(self.arm.tip.position_m),
                len(self.springs),
            )

    def _add_mass(self, mass: float, at: Array) -> None:
        self.masses.append((at, mass, len(self.springs)))

    def _add_row(self, row: int) -> None:
        joint, rows = self.arm.joints[row - 1], self._walk.rows[:, row - 1, 0]
        if joint.pose is not None:
            self._at = self._at + self._turn @ np.asarray(joint.pose.xyz_m)
            self._turn = self._turn @ rpy_matrix(np.radians(joint.pose.rpy_deg))
            self._add_yielding(Place("bearing", row))
        else:
            self._turn = self._turn @ rpy_matrix((rows[0], 0.0, 0.0))
            self._add_run(row, "a", rows[A])
            self._turn = self._turn @ rpy_matrix((0.0, 0.0, rows[THETA]))
            axis, slides = self._turn[:, 2].copy(), joint.type == "prismatic"
            if joint.type != "fixed":
                weights = self.arm.mixing[0][row - 1]
                place = None if slides else self._at.copy()
                self.moved.append((axis, place, weights, len(self.springs)))
            motor = self.arm.commanded.index(row) if row in self.arm.commanded else None
            springs = len(self.springs)
            self._add_yielding(Place("bearing", row, motor, slides))
            if motor is not None and not slides and len(self.springs) > springs:
                self.bearings[motor] = springs, axis
            self._add_run(row, "d", rows[D])
        self._add_yielding(Place("frame", row))
        self._add_frame(row)

    def _add_run(self, row: int, role: str, size: float) -> None:
        """Add springs and masses along the rods of a row's role."""
        along = (1.0 if size >= 0.0 else -1.0) * self._turn[:, 0 if role == "a" else 2]
        beams = [b for b in self.arm.links if b.row == row and b.role == role]
        fixed = sum(b.length_m for b in beams if b.length_m != "rest")
        lengths = [abs(size) - fixed if b.length_m == "rest" else b.length_m for b in beams]
        ends, begin = np.cumsum(lengths), self._at
        bodies = [
            (b.mass_kg, e, e - (b.body_length_m or length))
            for b, e, length in zip(beams, ends, lengths, strict=True)
        ]
        for mass, end, start in bodies:  # bodies that reach back past the row's beginning
            behind = max(-start, 0.0)
            self._add_mass(mass * behind / (end - start), begin - 0.5 * behind * along)
        for beam, end, length in zip(beams, ends, lengths, strict=True):
            if beam.length_m == "rest":
                overlap = np.full(3, min(max((beam.body_length_m or 0.0) - length, 0.0), end))
                self._at = begin + along * (end - length)
                self._add_yielding(Place("slide", row, beam=beam, overlap=overlap))
            first, second, torsion = beam.stiffness
            order = (torsion, first, second) if role == "a" else (first, second, torsion)
            soft = 1.0
            for effect in self._hidden:
                soft = soft * float(np.ravel(effect.softness(beam, self._state))[0])
            piece = length / PIECES
            for k in range(PIECES):
                near = end - length + k * piece
                inside = sum(
                    m / (e - s) * max(min(e, near + piece) - max(s, near), 0.0)
                    for m, e, s in bodies
                )
                self._add_mass(0.5 * inside, begin + along * near)
                self._add_spring(
                    begin + along * (near + 0.5 * piece), np.diag(piece * soft / np.array(order))
                )
                self._add_mass(0.5 * inside, begin + along * (near + piece))
        self._at = begin + along * abs(size)


def compute_vibration(true: TrueArm, q: Array) -> _Vibration:
    """Return modes of the true arm about one posture (n,), its drives held."""
    built = _Build(true, q)
    points = [*((at, before) for at, _, before in built.masses), built.tip]
    at, before = np.array([p for p, _ in points]), np.array([count for _, count in points])
    where = np.array([p for p, _ in built.springs]).reshape(-1, 3)
    root = np.array([r for _, r in built.springs]).reshape(-1, 3, 3)
    lever = at[:, None] - where  # (points, springs, 3)
    beyond = np.arange(len(where)) < before[:, None]
    swing = np.cross(root[None], lever[..., None], axisa=2, axisb=2, axisc=2)
    gives = np.where(beyond[..., None, None], swing, 0.0).swapaxes(1, 2).reshape(len(at) * 3, -1)
    turns = np.zeros((3 * len(points), true.arm.n))
    for axis, place, weights, springs in built.moved:
        moved = np.broadcast_to(axis, at.shape) if place is None else np.cross(axis, at - place)
        moved = np.where((springs <= before)[:, None], moved, 0.0)
        turns += np.outer(moved.ravel(), weights)
    mass = np.repeat([m for _, m, _ in built.masses], 3)
    heavy, hang = gives[:-3], turns[:-3]
    values, axes = np.linalg.eigh(heavy.T @ (mass[:, None] * heavy))
    chosen = np.flatnonzero(values > 1e-12 * max(values.max(initial=0.0), 1e-30))[::-1][:MODES]
    omega = 1.0 / np.sqrt(values[chosen])
    shape = heavy @ axes[:, chosen] * omega
    turned = np.zeros((true.arm.n, len(chosen)))
    for joint, (spring, axis) in built.bearings.items():
        parts = axes[3 * spring : 3 * spring + 3, chosen]
        turned[joint] = axis @ root[spring] @ parts * omega
    return _Vibration(
        omega,
        shape,
        mass,
        gives[-3:] @ axes[:, chosen] * omega,
        hang,
        -shape.T @ (mass[:, None] * hang),
        turned,
    )


class Ringing:
    """The tip's vibration while the joints move.

    Args:
        true: the arm at rest.
        damping: share of critical damping of every mode.
    """

    def __init__(self, true: TrueArm, damping: float) -> None:
        if not 0.0 < damping < 1.0:
            raise InputError("simulated arm", "damping", damping, "above 0 and below 1")
        self._true, self._damping = true, damping
        self._about: tuple[Array, _Vibration] | None = None
        self._last: tuple[float, Array, Array] | None = None  # time, joints, their speed
        self._wave = np.zeros(0, complex)

    def move_joints(self, t_s: float, q: Array) -> Array:
        """Move the joints to q (n,) by a time (s); return the tip's displacement then, (3,), m."""
        before, came, speed = self._last or (t_s, q, np.zeros_like(q))
        now = self._find_modes(q, speed)
        if t_s > before:
            fresh = (q - came) / (t_s - before)
            rate = self._complex_rate(now)
            kick = now.driven @ (fresh - speed) / (1j * rate.imag)  # when the last span began
            self._wave = (self._wave + kick) * np.exp(rate * (t_s - before))
            before, came, speed = t_s, q, fresh
        self._last = before, came, speed
        return np.asarray(now.tip @ self._wave.real)

    def tip_ring(self, since_s: Array) -> Array:
        """Return the tip's displacement (N, 3), m, after times (N,), s, at which joints rest."""
        modes, waves = self._waves_after(since_s)
        return waves @ modes.tip.T

    def joint_ring(self, since_s: Array) -> Array:
        """Return what encoders at the joints' output see of the vibration, (N, n), rad and m.

        The times are as in `tip_ring`.
        """
        modes, waves = self._waves_after(since_s)
        return waves @ modes.turned.T

    def _waves_after(self, since_s: Array) -> tuple[_Vibration, Array]:
        """Return the present modes, and their displacements (N, k) after times (N,), s."""
        assert self._about is not None
        modes = self._about[1]
        turns = np.exp(np.multiply.outer(since_s, self._complex_rate(modes)))
        return modes, np.real(self._wave * turns)

    def _complex_rate(self, modes: _Vibration) -> Array:
        """Return the complex rates (k,), 1/s, of the modes: decay and angular frequency."""
        return modes.omega * (-self._damping + 1j * np.sqrt(1.0 - self._damping**2))

    def _find_modes(self, q: Array, speed: Array) -> _Vibration:
        """Return the modes near a posture; new ones take over the present vibration."""
        span = self._true.arm.upper - self._true.arm.lower
        # of a joint's range: so far the modes are those of the posture before
        if self._about is not None and (np.abs(q - self._about[0]) <= 0.02 * span).all():
            return self._about[1]
        new = compute_vibration(self._true, q)
        if self._about is None:
            self._wave = np.zeros(len(new.omega), complex)
        else:
            old, rate = self._about[1], self._complex_rate(new)
            pace = (self._complex_rate(old) * self._wave).real
            pull = new.shape.T * new.mass  # the masses go on where they are and as they move
            there = pull @ (old.shape @ self._wave.real)
            then = pull @ (old.shape @ pace + (old.carried - new.carried) @ speed)
            self._wave = there - 1j * (then - rate.real * there) / rate.imag
        self._about = np.array(q), new
        return new
