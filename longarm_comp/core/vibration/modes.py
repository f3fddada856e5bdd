"""Vibration modes of the arm at a posture with its drives held, from the model.

A mass ``m_k`` that accelerates acts with the force ``-m_k a_k``.  The effects' twists under small
forces at every mass give the arm's flexibility matrix ``G``, so free vibration is ``u = w^2 G M u``
(Meirovitch, *Fundamentals of Vibrations*, 7.2).  Every effect that bends under weight counts.  Play
is taken up: its flexibility is the slope beyond it.

Masses of beams are lumped at the ends of their elements.  Left out: rotary inertia of sections,
shear, and what weight adds to the stiffness.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.measuring import VISIBLE_M
from longarm_comp.core.arm.posture import LineLoads, Lumped, Posture
from longarm_comp.core.arm.spatial import Frame, Scalar, Vec
from longarm_comp.core.ik.kernel import rigid_jacobian
from longarm_comp.core.model.model import Model, unstack

MODES = 6
"""Modes that are kept, the slowest first."""
_PUSH = 0.1
"""Test force as a share of the arm's weight: enough to take up play, too little to bend it far."""


@dataclass(frozen=True, eq=False)
class Modes:
    """The slowest modes at a posture, the slowest first; scaled to a modal mass of 1 kg."""

    omega: np.ndarray  # (k,) rad/s, undamped
    tip: np.ndarray  # (k, 3) motion of the tip, m per unit of the mode
    shape: np.ndarray  # (k, m) motion of all masses along x, y, z
    mass: np.ndarray  # (m,) kg
    carried: np.ndarray  # (m, n) motion of all masses by a unit of each joint, the bend held

    @property
    def hz(self) -> np.ndarray:
        """The undamped frequencies (k,), Hz."""
        return np.asarray(self.omega / (2.0 * np.pi))

    @cached_property
    def driven(self) -> np.ndarray:
        """The (k, n) force on each mode by a unit acceleration of each joint."""
        return np.asarray(-(self.shape * self.mass) @ self.carried)


def find_modes(model: Model, q: np.ndarray, context: Context | None = None) -> Modes:
    """Return the modes of a model's arm at joints (n,), rad and m; none if it does not bend.

    Of the circumstances, the payload matters most.
    """
    return find_modes_along(model, np.asarray(q, float)[None], 1, context)[0]


def find_modes_along(
    model: Model, joints: np.ndarray, count: int, context: Context | None = None
) -> list[Modes]:
    """Return the modes at `count` evenly spaced places along a motion.

    They are computed from masses and flexibility at the given joints, with cubic splines between.
    Effects of circumstances that the context does not hold are left out.

    Args:
        joints: (N, n) rad and m, at evenly spaced places of the motion; if N is 1, so is `count`.
    """
    context = context or Context()
    model = model.told_by(context)
    # Of all beams together, at least; twice as many change the first frequencies by less than 1 %
    each = -(-12 // max(1, len(model.arm.links)))
    fine = replace(model, elements_per_beam=max(each, model.elements_per_beam))
    posture = fine.posture(unstack(joints), context)
    known, tip = len(joints), model.arm.tip
    # The last is the tip, without mass
    points = [*_list_masses(posture), Lumped(posture.frame(tip.frame), 0.0, tip.position_m)]
    mass = np.repeat(np.array([np.broadcast_to(p.mass, known) for p in points]).T, 3, axis=1)
    bends = _flexibility(fine, posture, points, known)
    places = [posture.frames[p.station].transform(p.position) for p in points]
    moved = [rigid_jacobian(posture, at, p.station) for at, p in zip(places, points, strict=True)]
    by_point = [_points([linear for linear, _ in columns], known) for columns in moved]
    carried = np.concatenate([columns.swapaxes(1, 2) for columns in by_point], axis=1)
    if known > 1:
        from scipy.interpolate import CubicSpline

        asked, given = np.linspace(0.0, 1.0, count), np.linspace(0.0, 1.0, known)
        mass, bends, carried = (CubicSpline(given, x)(asked) for x in (mass, bends, carried))
    found = []
    for m, bend, by_joints in zip(np.maximum(mass, 0.0), bends, carried, strict=True):
        root = np.sqrt(m)
        values, shapes = np.linalg.eigh(root[:, None] * bend * root)
        chosen = np.flatnonzero(values > _STIFF * max(values[-1], VISIBLE_M / 9.81))[::-1][:MODES]
        omega = 1.0 / np.sqrt(values[chosen])
        shape = ((bend @ (root[:, None] * shapes[:, chosen])) * omega**2).T
        found.append(Modes(omega, shape[:, -3:], shape[:, :-3], m[:-3], by_joints[:-3]))
    return found


_STIFF = 1e-4
"""A mode is left out if its ``1 / w^2`` is below this share of that of the slowest mode, or of one
that sags visibly: it is 100 times as fast."""


def _list_masses(posture: Posture) -> list[Lumped]:
    """Return all masses of the arm, each at a station; beams at the ends of their elements."""
    ends: dict[int, Scalar] = {}
    for station, spread in posture.line_loads.items():
        length = spatial.absolute(posture.lengths[station])
        for density, loaded in spread:
            near = 0.5 * loaded / length * density * loaded  # share with the same centre
            ends[station] = ends.get(station, 0.0) + density * loaded - near
            ends[station - 1] = ends.get(station - 1, 0.0) + near
    beams = [Lumped(station, mass, spatial.ZERO) for station, mass in ends.items()]
    return posture.station_masses() + beams


@dataclass(frozen=True)
class _Pushed(Posture):
    """A posture that carries only test forces, given as masses (kg) under a gravity."""

    pushes: Sequence[Lumped] = ()

    def station_masses(self) -> list[Lumped]:
        return list(self.pushes)

    @cached_property
    def line_loads(self) -> LineLoads:
        return {e.station: [] for e in self.chain.elements}


def _flexibility(model: Model, posture: Posture, points: list[Lumped], postures: int) -> np.ndarray:
    """Return the flexibility (N, 3 P, 3 P), m/N, of P points along the base's axes at N postures.

    All test forces at all postures are computed as one posture of N times 4 times 3 P rows.
    """
    count = 3 * len(points)
    heaviest = float(np.max(sum(p.mass for p in points)))
    weight = heaviest * float(np.linalg.norm(model.arm.gravity_mps2)) or 1.0
    sizes = np.tile(_PUSH * weight * np.repeat([1.0, 2.0, -1.0, -2.0], count), postures)
    which = np.tile(np.repeat(np.arange(len(points)), 3), 4 * postures)
    along = np.tile(np.arange(count) % 3, 4 * postures)

    def rows(scalars: tuple[Scalar, ...]) -> tuple[Any, ...]:
        return tuple(x if np.ndim(x) == 0 else np.repeat(x, 4 * count) for x in scalars)

    frames = [Frame(*(rows(part) for part in frame)) for frame in posture.frames]
    pushes = [
        Lumped(p.station, (which == k).astype(float), rows(p.position))  # type: ignore[arg-type]
        for k, p in enumerate(points)
    ]
    x, y, z = (np.where(along == axis, sizes, 0.0) for axis in range(3))
    context = posture.context.take(np.repeat(np.arange(postures), 4 * count))
    pushed = _Pushed(
        posture.chain,
        rows(posture.q),
        context,
        frames,
        list(rows(tuple(posture.lengths))),
        (x, y, z),
        pushes=pushes,
    )
    moved = np.zeros((postures, len(points), 3, count))
    carriers = np.array([p.station for p in points])
    places = _points([posture.frames[p.station].transform(p.position) for p in points], postures)
    for station, twist in model.twists(pushed).items():
        slopes = []
        for part in (twist[:3], twist[3:]):
            seen = frames[station].rotate(part)
            answers = np.stack([np.broadcast_to(x, 4 * count * postures) for x in seen])
            up, twice, down, back = answers.reshape(3, postures, 4, -1).transpose(2, 1, 0, 3)
            slopes.append(((twice - up) - (back - down)) / (2.0 * _PUSH * weight))
        d, delta = slopes  # between one and two pushes, to either side
        after = carriers >= station
        levers = places[:, after] - _points([posture.frames[station].p], postures)
        turned = np.cross(delta[:, None], levers[..., None], axisa=2, axisb=2, axisc=2)
        moved[:, after] += d[:, None] + turned
    bends = moved.reshape(postures, count, count)
    return 0.5 * (bends + bends.swapaxes(1, 2))


def _points(places: Sequence[Vec], postures: int) -> np.ndarray:
    """Stack P vectors, whose components are scalars or (N,), to (N, P, 3)."""
    rows = [[np.broadcast_to(x, postures) for x in place] for place in places]
    return np.array(rows, float).transpose(2, 0, 1)
