"""Modes of the arm at a posture, its drives held: of stiffness and masses that the model knows.

A mass ``m_k`` that accelerates pushes with ``-m_k a_k``.  What the effects' twists answer to small
pushes at every mass is the arm's flexibility ``G``, so free vibration is ``u = w^2 G M u``
(Meirovitch, *Fundamentals of Vibrations*, 7.2).  No effect is named here: whatever bends under
weight, bends under a push.  Play is taken up: its flexibility is the slope beyond it.

Masses of beams are lumped at the ends of their elements.  Left out: rotary inertia of sections,
shear, and what weight adds to the stiffness.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.posture import LineLoads, Posture
from longarm_comp.core.arm.spatial import Scalar, Vec
from longarm_comp.core.ik.kernel import geometric
from longarm_comp.core.model.model import Model

MODES = 6
"""Modes that are kept, the slowest first."""
_PUSH = 0.1
"""Of the arm's weight: well beyond its play, and no large bend."""


@dataclass(frozen=True)
class Mass:
    """A lumped mass: kg, at a point (m) in the axes of a station."""

    station: int
    at: Vec
    mass: float


@dataclass(frozen=True, eq=False)
class Modes:
    """The slowest modes at a posture, the slowest first; scaled to a modal mass of 1 kg.

    Attributes:
        omega: (k,) rad/s, undamped.
        tip: (k, 3) motion of the tip, m per unit of the mode.
        driven: (k, n) how a unit of each joint's acceleration drives a mode.
    """

    omega: np.ndarray
    tip: np.ndarray
    driven: np.ndarray

    @property
    def hz(self) -> np.ndarray:
        """(k,) frequencies."""
        return np.asarray(self.omega / (2.0 * np.pi))


def modes(model: Model, q: np.ndarray, context: Context | None = None) -> Modes:
    """Modes of a model's arm at joints (n,); none of an arm that does not bend.

    Args:
        model: calibrated, or the arm as declared.
        q: (n,) rad and m.
        context: circumstances; the payload above all.
    """
    # Of all beams together, at least; twice as many change the first frequencies by less than 1 %
    each = -(-12 // max(1, len(model.arm.links)))
    fine = replace(model, elements_per_beam=max(each, model.elements_per_beam))
    posture = fine.posture(tuple(float(x) for x in q), context)
    masses = _masses_of(posture)
    n, tip = model.arm.n, model.arm.tip
    points = [*masses, Mass(posture.frame(tip.frame), tip.position_m, 0.0)]
    root = np.repeat(np.sqrt([p.mass for p in points]), 3)
    bend = flexibility(fine, posture, points)
    values, shapes = np.linalg.eigh(root[:, None] * bend * root)
    chosen = np.flatnonzero(values > _ROUNDING * max(values[-1], 0.0))[::-1][:MODES]
    if not len(chosen):
        return Modes(np.zeros(0), np.zeros((0, 3)), np.zeros((0, n)))
    omega, shape = 1.0 / np.sqrt(values[chosen]), shapes[:, chosen]
    moved = (bend @ (root[:, None] * shape)) * omega**2  # of points without mass too
    carried = np.concatenate([_carried(posture, p) for p in points])
    return Modes(omega, moved[-3:].T, -shape.T @ (root[:, None] * carried))


_ROUNDING = 1e-9
"""Smaller eigenvalues, compared with the largest, are rounding."""


def _masses_of(posture: Posture) -> list[Mass]:
    """All masses of the arm, each at a station; beams at the ends of their elements."""
    found: dict[tuple[int, Vec], float] = defaultdict(float)
    for station, held in posture.station_masses().items():
        for mass, (x, y, z) in held:
            found[station, (float(x), float(y), float(z))] += float(mass)
    for station, spread in posture.line_loads.items():
        length = abs(float(posture.lengths[station]))
        for density, loaded in spread:
            if loaded > 0.0:
                near = 0.5 * float(loaded) / length  # share with the same centre
                mass = float(density * loaded)
                found[station, spatial.ZERO] += (1.0 - near) * mass
                found[station - 1, spatial.ZERO] += near * mass
    return [Mass(station, at, mass) for (station, at), mass in found.items() if mass > 0.0]


@dataclass(frozen=True)
class _Pushed(Posture):
    """A posture that carries nothing but pushes: masses (kg) by station under a gravity."""

    pushes: Mapping[int, list[tuple[Scalar, Vec]]] = field(default_factory=dict)

    def station_masses(self) -> dict[int, list[tuple[Scalar, Vec]]]:
        return dict(self.pushes)

    @cached_property
    def line_loads(self) -> LineLoads:
        rows = self.chain.rows
        return {e.station: [] for row in rows for e in (*row.elements_a, *row.elements_d)}


def flexibility(model: Model, posture: Posture, points: list[Mass]) -> np.ndarray:
    """(3 P, 3 P) m/N: motion of every point by a push along x, y, z of the base at every point."""
    count = 3 * len(points)
    weight = sum(p.mass for p in points) * float(np.linalg.norm(posture.gravity)) or 1.0
    sizes = _PUSH * weight * np.repeat([1.0, 2.0, -1.0, -2.0], count)
    which = np.tile(np.repeat(np.arange(len(points)), 3), 4)
    along = np.tile(np.arange(count) % 3, 4)
    pushes: dict[int, list[tuple[Scalar, Vec]]] = {}
    for k, p in enumerate(points):
        pushes.setdefault(p.station, []).append(((which == k).astype(float), p.at))
    x, y, z = (np.where(along == axis, sizes, 0.0) for axis in range(3))
    pushed = _Pushed(
        posture.chain, posture.q, posture.context, posture.frames, posture.lengths, (x, y, z),
        pushes=pushes,
    )  # fmt: skip
    moved = np.zeros((len(points), 3, count))
    carriers = np.array([p.station for p in points])
    places = np.array([posture.frames[p.station].transform(p.at) for p in points], float)
    for station, twist in model.twists(pushed).items():
        frame = posture.frames[station]
        d, delta = (
            np.stack([np.broadcast_to(x, 4 * count) for x in frame.rotate(part)])
            for part in (twist[:3], twist[3:])
        )
        d, delta = (_slope(x) / (2.0 * _PUSH * weight) for x in (d, delta))
        after = carriers >= station
        levers = places[after] - np.array(frame.p, float)
        moved[after] += d + np.cross(delta, levers[:, :, None], axisa=0, axisb=1, axisc=1)
    bend = moved.reshape(count, count)
    return 0.5 * (bend + bend.T)


def _slope(answers: np.ndarray) -> np.ndarray:
    """Twice the push times the slope between one and two pushes to either side, (3, N)."""
    up, twice, down, back = np.split(answers, 4, axis=1)
    return np.asarray((twice - up) - (back - down))


def _carried(posture: Posture, point: Mass) -> np.ndarray:
    """(3, n): motion of a point by a unit of every joint, the bend held."""
    place = posture.frames[point.station].transform(point.at)
    return np.array([linear for linear, _ in geometric(posture, place, point.station)], float).T
