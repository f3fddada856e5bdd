"""The simulated real arm: declared parts, hidden effects, exact elastic rods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.parts import Beam, Tube
from longarm_comp.core.errors import InputError
from longarm_comp.sim.context import Array, State, TrueContext
from longarm_comp.sim.hidden.base import THETA, D, HiddenEffect, Place
from longarm_comp.sim.rods import STEPS, Walker, rpy_matrix, settle


@dataclass(frozen=True)
class Settled:
    """The arm at rest, N postures."""

    pose: Array  # tip in the base frame, (N, 4, 4)
    torques: Array
    """Moment of the weight about each motor's axis (N m), along it if it slides (N), (N, n)."""


class Walk:
    """The whole chain for given joint values, integrated from the last frame to the base.

    Attributes:
        gravity: (3,) m/s^2, base frame.
        base: (6,) x, y, z, roll, pitch, yaw of the foot, m and rad.
        rows: (4, R, N) alpha, a, theta, d, rad and m.
        masses: mass (kg) and position (m) of every mass, by frame.
    """

    def __init__(self, true: TrueArm, state: State, held: Array | float = 0.0) -> None:
        arm = true.arm
        self._true, self._arm, self._state, self._hidden = true, arm, state, true.hidden
        self._motor = {row: k for k, row in enumerate(arm.commanded)}
        q = state.q
        for effect in self._hidden:
            q = effect.joints(q, state)
        mixing, offset = arm.mixing
        value = ((q + held) @ mixing.T + offset).T
        rows = np.array(
            [
                [np.radians(j.alpha_deg), j.a_m, np.radians(j.theta_offset_deg), j.d_m]
                for j in arm.joints
            ]
        ).T[:, :, None] + np.zeros((4, 1, len(q)))
        for effect in self._hidden:
            rows = effect.rows(rows, state)
        for k, joint in enumerate(arm.joints):
            if joint.type != "fixed":
                rows[THETA if joint.type == "revolute" else D, k] += value[k]
        self.rows = rows
        masses: list[list[tuple[Array | float, tuple[float, float, float]]]]
        self.masses = masses = [[] for _ in range(len(arm.joints) + 1)]
        for m in arm.point_masses:
            masses[m.frame].append((m.mass_kg, m.position_m))
        if arm.payload is not None:
            masses[arm.payload.frame].append((state.payload_kg, arm.payload.position_m))
        for effect in self._hidden:
            for frame, mass, at in effect.masses(state):
                masses[frame].append((mass, at))
        self.gravity = np.asarray(arm.gravity_mps2, float)
        base = np.array([*arm.base.xyz_m, *np.radians(arm.base.rpy_deg)])
        for effect in self._hidden:
            self.gravity, base = effect.gravity(self.gravity), effect.base(base)
        self.base = base

    def rigid(self) -> Array:
        """Return gravity in the last frame's axes, (3, N), m/s^2, as if the arm had no weight."""
        small = 1e-9  # m/s^2 along each axis: it bends nothing
        gamma = np.broadcast_to(small * np.eye(3)[..., None], (3, 3, len(self._state.q)))
        return np.tensordot(self.gravity, self._walk_back(gamma)[0].gravity / small, 1)

    def solve(self, start: Array) -> Array:
        """Return gravity in the last frame's axes of the arm at rest, (3, N), m/s^2.

        Args:
            start: (3, N) first guess.
        """
        return settle(lambda gamma: self._walk_back(gamma)[0], start, self.gravity)

    def finish(self, gamma: Array) -> Settled:
        """Return the arm at rest for the gravity (3, N) that `solve` found."""
        end, marks, torques = self._walk_back(gamma[:, None], tip=True)
        pose = np.zeros((gamma.shape[1], 4, 4))
        pose[:, 3, 3] = 1.0
        for column, mark in enumerate(marks):
            pose[:, :3, column] = end.get_mark(mark)[:, 0].T
        return Settled(pose, torques)

    def _walk_back(self, gamma: Array, *, tip: bool = False) -> tuple[Walker, list[int], Array]:
        """Integrate to the base. Returns the walker there, its marks and the joint loads."""
        walker = Walker(gamma)
        marks: list[int] = []
        torques = np.zeros_like(self._state.q)
        for row in range(len(self._arm.joints), -1, -1):
            self._apply_effects(walker, Place("frame", row))
            for mass, at in self.masses[row]:
                walker.hang(mass, at)
            if tip and row == self._arm.tip.frame:
                matrix = rpy_matrix(np.radians(self._arm.tip.rpy_deg))
                marks += [walker.mark(c, point=False) for c in matrix.T]
                marks.append(walker.mark(self._arm.tip.position_m, point=True))
            if row > 0:
                self._walk_row(walker, row, torques)
        self._apply_effects(walker, Place("base", 0))
        for effect in self._hidden:
            walker.shift(np.broadcast_to(effect.foot(self._state), (3, len(self._state.q))))
        walker.rotate(rpy_matrix(self.base[3:]))
        walker.shift(self.base[:3])
        return walker, marks, torques

    def _walk_row(self, walker: Walker, row: int, torques: Array) -> None:
        """Go back through one row: frame, Tz with its rods, bearing, Rz, Tx with its rods, Rx."""
        joint = self._arm.joints[row - 1]
        alpha, a, theta, d = self.rows[:, row - 1]
        motor = self._motor.get(row)
        place = Place("bearing", row, motor, joint.type == "prismatic")
        if joint.pose is not None:
            self._apply_effects(walker, place)
            walker.rotate(rpy_matrix(np.radians(joint.pose.rpy_deg)))
            walker.shift(np.asarray(joint.pose.xyz_m))
            return
        self._walk_run(walker, row, "d", d)
        if motor is not None:
            load = walker.force if joint.type == "prismatic" else walker.moment
            torques[:, motor] = load[2, 0]
        self._apply_effects(walker, place)
        walker.turn(2, theta)
        self._walk_run(walker, row, "a", a)
        walker.turn(0, alpha)

    def _walk_run(self, walker: Walker, row: int, role: str, size: Array) -> None:
        """Go back along the rods of a row's role and the rigid rest of its size (N,)."""
        beams = [b for b in self._arm.links if b.row == row and b.role == role]
        axis = 0 if role == "a" else 2
        sign = -1.0 if np.all(size < 0) else 1.0
        fixed = sum(b.length_m for b in beams if b.length_m != "rest")
        lengths = [
            np.maximum(sign * size - fixed, 0.0) if b.length_m == "rest" else 0 * size + b.length_m
            for b in beams
        ]
        rest = size - sign * sum(lengths, np.zeros_like(size))
        if np.any(rest != 0.0):
            walker.shift(np.stack([rest if k == axis else 0 * rest for k in range(3)]))
        ends = np.cumsum([0 * size, *lengths], axis=0)
        for k in range(len(beams) - 1, -1, -1):
            self._walk_beam(walker, axis, sign, beams, ends, k)
            if beams[k].length_m == "rest":
                body = beams[k].body_length_m or 0.0
                overlap = np.minimum(np.maximum(body - lengths[k], 0.0), ends[k])
                self._apply_effects(walker, Place("slide", row, beam=beams[k], overlap=overlap))
        for beam, end in zip(beams, ends[1:], strict=True):
            behind = np.maximum((beam.body_length_m or 0.0) - end, 0.0)
            if np.any(behind > 0.0):  # a body that reaches back past the row's beginning
                at = -sign * behind / 2
                mass = beam.mass_kg * behind / (beam.body_length_m or 1.0)
                walker.hang(mass, np.stack([at if i == axis else 0 * at for i in range(3)]))

    def _walk_beam(
        self, walker: Walker, axis: int, sign: float, beams: list[Beam], ends: Array, k: int
    ) -> None:
        """Go back along one beam, divided at the beginnings of the bodies inside it."""
        first, second, torsion = beams[k].stiffness
        order = (torsion, first, second) if axis == 0 else (first, second, torsion)
        compliance = np.reshape(order, (3, 1)) ** -1.0
        for effect in self._hidden:
            compliance = compliance * effect.softness(beams[k], self._state)
        stretch = _compute_stretch(beams[k], axis) if self._true.shear else None
        bodies = [
            (b.mass_kg / length, np.clip(ends[j + 1] - length, ends[k], ends[k + 1]))
            for j, b in enumerate(beams)
            if j >= k and b.mass_kg > 0
            for length in (b.body_length_m if b.body_length_m else ends[j + 1] - ends[j],)
        ]
        cuts = np.sort(np.stack([ends[k], *(start for _, start in bodies), ends[k + 1]]), axis=0)
        for near, far in zip(cuts[-2::-1], cuts[:0:-1], strict=True):
            if np.all(far == near):
                continue
            middle = (near + far) / 2
            density = sum((rho * (start < middle) for rho, start in bodies), np.zeros_like(near))
            walker.rod(axis, sign, far - near, compliance, density, self._true.steps, stretch)

    def _apply_effects(self, walker: Walker, place: Place) -> None:
        for effect in reversed(self._hidden):
            for force, at in effect.push(place, self._state):
                walker.push(force, at)
            vector = effect.give(place, walker, self._state)
            if vector is not None:
                walker.give(vector)


def _compute_stretch(beam: Beam, axis: int) -> Array | None:
    """Return 1/(kGA, kGA, EA) of a tube in the order of the axes, 1/N; None for other sections.

    Cowper's shear coefficient of the hollow round (J. Appl. Mech. 33, 1966).
    """
    if not isinstance(beam.section, Tube) or beam.E_pa is None:
        return None
    _, _, torsion = beam.stiffness
    shear_modulus = torsion / beam.section.second_moments()[2]
    nu = beam.E_pa / (2 * shear_modulus) - 1
    area = np.pi / 4 * (beam.section.od_m**2 - beam.section.id_m**2)
    m2 = (beam.section.id_m / beam.section.od_m) ** 2
    k = 6 * (1 + nu) * (1 + m2) ** 2 / ((7 + 6 * nu) * (1 + m2) ** 2 + (20 + 12 * nu) * m2)
    across, along = 1 / (k * shear_modulus * area), 1 / (beam.E_pa * area)
    return np.array([along, across, across] if axis == 0 else [across, across, along])


class TrueArm:
    """The true arm: the declared arm with hidden effects.

    Args:
        hidden: undeclared effects, in the order in which they act on the joints. Effects on the
            command (a servo's rounding) always come first.
        steps: integration steps per piece of rod.
        shear: include shear and extension of tubes (0.04 mm on an arm that sags by 13 mm).
    """

    def __init__(
        self,
        arm: Arm,
        hidden: Sequence[HiddenEffect] = (),
        *,
        steps: int = STEPS,
        shear: bool = False,
    ) -> None:
        if any(m.position_columns for m in arm.point_masses):
            raise InputError("simulated arm", "position_columns", "set", "masses at fixed places")
        for effect in hidden:
            if not isinstance(effect, HiddenEffect):
                raise InputError(
                    "simulated arm", "hidden", type(effect).__name__, "effects of the arm's side"
                )
        self.arm = arm
        self.hidden = tuple(sorted(hidden, key=lambda effect: not effect.of_command))
        self.steps, self.shear = steps, shear

    def tip(self, q: Array, context: TrueContext | None = None) -> Array:
        """Return the true tip in the base frame, (N, 3) m, for commanded joints (N, n) or (n,)."""
        return self.pose(q, context)[..., :3, 3]

    def pose(self, q: Array, context: TrueContext | None = None) -> Array:
        """Return the true tip frame in the base frame, (N, 4, 4), or (4, 4) for one posture."""
        pose = self.settle(q, context).pose
        return pose if np.ndim(q) == 2 else pose[0]

    def shafts(self, q: Array, context: TrueContext | None = None) -> Array:
        """Return the joint values that motors' encoders see, (N, n), rad or m.

        Effects behind the encoders are left out.
        """
        state, torques = State.of(self.arm, q, context), self.settle(q, context).torques
        return state.q + sum((e.before(torques, state) for e in self.hidden), np.zeros(1))

    def settle(self, q: Array, context: TrueContext | None = None) -> Settled:
        state = State.of(self.arm, q, context)
        walk = Walk(self, state)
        gamma = walk.solve(walk.rigid())
        if any(effect.gated for effect in self.hidden):
            torques = walk.finish(gamma).torques
            held = sum((e.find_rest(torques, state) for e in self.hidden), np.zeros_like(state.q))
            walk = Walk(self, state, held)
            gamma = walk.solve(gamma)
        return walk.finish(gamma)
