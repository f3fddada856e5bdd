"""Motion of the tip, and of what a sensor reports of it, by each parameter of a model.

A parameter of the arm moves the tip: by Eq. (5) a shift of the point and a rotation of its axes.  A
parameter of the measuring side changes what is reported of a tip that does not move.  A kind of
measurement (`core/data/measurement.py`) makes its equations of both.
"""

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from longarm_comp.core.arm import spatial, stacked
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.posture import PLACEMENT, Posture
from longarm_comp.core.arm.spatial import IDENTITY, Frame, Scalar, Twist, Vec
from longarm_comp.core.model import encoders
from longarm_comp.core.model.encoders import Parts

_H = 1e-3
"""Step (of a unit parameter, of a rad) of differences through the measuring side."""


_Model = Any
"""`Model`; its type cannot be imported here, as its module imports this one."""


@dataclass(frozen=True)
class _Moved:
    """A change of the arm: shift of the tip (m) and turn of its axes (rad), in the base frame."""

    shift: Vec
    turn: Vec


@dataclass(frozen=True)
class Reseen:
    """A change of the measuring side: ``per`` times the difference of two models' reports."""

    raised: _Model
    lowered: _Model
    per: float
    sees: frozenset[str]


class TwistChange(NamedTuple):
    """A change of effects' twists: ``per`` times (raised - lowered)."""

    raised: Parts
    lowered: Parts
    per: float


@dataclass(frozen=True)
class TipMotion:
    """The tip of a model at N postures and its change by each of p parameters.

    Attributes:
        frame: pose of the tip in the base frame.
        changes: one per parameter.
        ends: changes of twists, one per parameter of the arm's side.
    """

    model: _Model
    posture: Posture
    frame: Frame
    changes: Sequence[_Moved | Reseen]
    ends: Sequence[TwistChange]

    @cached_property
    def context(self) -> Context:
        """Circumstances of the postures."""
        return self.posture.context

    @cached_property
    def joints(self) -> list[Scalar]:
        """The joint values that the encoders see, n scalars, rad or m."""
        parts = [(e, e.twists(self.posture)) for e in self.model.effects]
        off = encoders.seen(self.posture.chain, parts)
        return [q + by for q, by in zip(self.posture.q, off, strict=True)]

    @cached_property
    def joint_changes(self) -> list[list[Scalar]]:
        """The change of `joints` per unit of each parameter of the arm's side."""
        made = []
        for end in self.ends:
            up, down = (encoders.seen(self.posture.chain, part) for part in end[:2])
            made.append([end.per * (a - b) for a, b in zip(up, down, strict=True)])
        return made

    def point(self, kind: str = "position") -> tuple[np.ndarray, np.ndarray]:
        """Return the reported point (N, 3) in m and its derivative (N, 3, p)."""
        point, context = self.frame.p, self.context
        seen = self.model.seen(point, context, kind)
        gain = None if seen is point else self._report_of_shift(kind)
        blocks = []
        for change in self.changes:
            if isinstance(change, _Moved):
                block = change.shift if gain is None else gain.rotate(change.shift)
            elif kind in change.sees:
                up, down = (m.seen(point, context, kind) for m in (change.raised, change.lowered))
                block = spatial.scale(change.per, spatial.sub(up, down))
            else:
                block = spatial.ZERO
            blocks.append(block)
        return _together(stack(seen), blocks)

    def _report_of_shift(self, kind: str) -> Frame:
        """Return the derivative of the reported point by each coordinate of the tip, as axes."""
        made = []
        for axis in IDENTITY[:3]:
            by = spatial.scale(_H, axis)
            up, down = (
                self.model.seen(end, self.context, kind)
                for end in (spatial.add(self.frame.p, by), spatial.sub(self.frame.p, by))
            )
            made.append(spatial.scale(0.5 / _H, spatial.sub(up, down)))
        return Frame(made[0], made[1], made[2], spatial.ZERO)

    def read(self, joint: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the reading (N, 1) of a joint's encoder, rad or m, and its derivative (N, 1, p).

        Args:
            joint: 0-based number of the commanded joint.
        """
        at, model, row = self.joints[joint], self.model, self.model.arm.commanded[joint]
        gain = (model.read(at + _H, row) - model.read(at - _H, row)) * (0.5 / _H)
        moves = iter(self.joint_changes)
        each = [
            gain * next(moves)[joint]
            if isinstance(change, _Moved)
            else change.per * (change.raised.read(at, row) - change.lowered.read(at, row))
            for change in self.changes
        ]
        whole = np.broadcast_to(model.read(at, row), np.shape(stack(self.frame.p))[:-1])
        return _together(whole[..., None], [(column,) for column in each])

    def pull(self, kind: str) -> np.ndarray:
        """Return the derivative (N, 3, 3) of the reported point by the tip's position."""
        return _together(stack(self.frame.p), self._report_of_shift(kind)[:3])[1]

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the reported axes of the tip (N, 3, 3), and their rotation by each parameter.

        The latter is (N, 3, p), rad.  The rotation by a bias may depend on the position of the tip;
        that part of the derivative is left out.
        """
        seen = self.model.seen_axes(self.frame, self.context)
        gain = [self._report_of_turn(axis) for axis in IDENTITY[:3]]
        blocks = []
        for change in self.changes:
            block: Vec = spatial.ZERO
            if isinstance(change, _Moved):
                turned = [spatial.scale(w, g) for w, g in zip(change.turn, gain, strict=True)]
                block = spatial.add(spatial.add(turned[0], turned[1]), turned[2])
            elif "orientation" in change.sees:
                models = change.raised, change.lowered
                ends = [model.seen_axes(self.frame, self.context) for model in models]
                block = spatial.scale(change.per, spatial.small_rotation(ends[0], ends[1]))
            blocks.append(block)
        rotation = seen.matrix()[..., :3, :3]
        return rotation, _together(stack(self.frame.p), blocks)[1]

    def _report_of_turn(self, axis: Vec) -> Vec:
        """Return the rotation of the reported axes per rad of the tip about an axis of the base."""
        if self.model.seen_axes(IDENTITY, self.context) is IDENTITY:
            return axis
        ends = []
        for step in (_H, -_H):
            turn = spatial.exp((0.0, 0.0, 0.0, *spatial.scale(step, axis)))
            n, o, a = (turn.rotate(v) for v in self.frame[:3])
            tip = Frame(n, o, a, self.frame.p)
            ends.append(self.model.seen_axes(tip, self.context))
        return spatial.scale(0.5 / _H, spatial.small_rotation(ends[0], ends[1]))


def move_tip(posture: Posture, tip: Vec, ends: Sequence[TwistChange], turns: bool) -> list[_Moved]:
    """Return the tip's motion under each change of twists, by Eq. (5).

    Its point moves by ``sum_i R_i (d_i + delta_i x p_i)``, its axes by ``sum_i R_i delta_i``: R_i
    are the axes of station i, d_i and delta_i the changes of its translation and rotation, and p_i
    is the tip in these axes. The derivative is taken at the twist that the station already has, so
    it is exact also at a large twist, such as that of a displaced base. The arm beyond a station
    moves with it as one rigid body.

    Args:
        tip: position of the tip, base frame, m.
        turns: compute the rotation of the axes too; else it is 0.
    """
    changes = [list(_changes(e)) for e in ends]
    units = _all_units(posture, tip, {station for each in changes for station, *_ in each})
    made = []
    for each in changes:
        shifts = [by * units[station][k] for station, k, by in each]
        turned = [by * units[station][k - 3] for station, k, by in each if turns and k >= 3]
        summed = (tuple(sum(v[1:], v[0])) if v else spatial.ZERO for v in (shifts, turned))
        made.append(_Moved(*summed))  # type: ignore[arg-type]
    return made


def trace_shifts(posture: Posture, tip: Vec, ends: Sequence[TwistChange]) -> list[Vec]:
    """Return the shifts of `move_tip` in scalars of any kind, such as traced numbers."""
    units: dict[int, list[Vec]] = {}
    made = []
    for end in ends:
        shift = spatial.ZERO
        for station, k, by in _changes(end):
            if station not in units:
                twist = posture.twists.get(station, spatial.ZERO_TWIST)
                large = station == PLACEMENT
                units[station] = _units(twist, posture.frames[station], tip, large)
            shift = spatial.add(shift, spatial.scale(by, units[station][k]))
        made.append(shift)
    return made


def _changes(end: TwistChange) -> Iterator[tuple[int, int, Scalar]]:
    """Yield station, component of its twist (0 to 5) and change, for components that change."""
    raised, lowered = (
        part[0][1] if len(part) == 1 else spatial.sum_twists(twists for _, twists in part)
        for part in end[:2]
    )
    for station in sorted({*raised, *lowered}):
        up = raised.get(station, spatial.ZERO_TWIST)
        down = lowered.get(station, spatial.ZERO_TWIST)
        for k, (a, b) in enumerate(zip(up, down, strict=True)):
            if not (a is b or (type(a) is float and type(b) is float and a == b)):
                yield station, k, end.per * (a - b)


def _units(twist: Twist, frame: Frame, tip: Vec, large: bool) -> list[Vec]:
    """Return how a unit of each component of a station's twist moves the tip, base frame.

    The first three vectors are the shift of the tip by a unit translation, which is also the
    rotation of its axes by a unit rotation. The others are its shift by a unit rotation.

    Args:
        twist, frame: of the station.
        tip: position of the tip, base frame, m.
        large: whether the twist may be large.
    """
    here = frame.unrotate(spatial.sub(tip, frame.p))
    turns, shifts = spatial.tangent(twist, here, large)
    return [frame.rotate(unit) for unit in (*turns, *shifts)]


def _all_units(posture: Posture, tip: Vec, stations: Collection[int]) -> dict[int, np.ndarray]:
    """Return the `_units` of stations, (6, 3, ...) each; computed together, kept per posture."""
    shape = np.broadcast_shapes(*map(np.shape, tip))
    made: dict[int, np.ndarray] = posture.once(("units",), dict)
    size = math.prod(shape)
    for some in stacked.parts(set(stations) - made.keys(), 18 * size):
        twists = [posture.twists.get(station, spatial.ZERO_TWIST) for station in some]
        frames = [posture.frames[station] for station in some]
        x = stacked.stack_all(
            [(*t, *f.n, *f.o, *f.a, *f.p) for t, f in zip(twists, frames, strict=True)]
        )
        frame = Frame(x[6:9], x[9:12], x[12:15], x[15:])
        moves = np.empty((len(some), 6, 3, size))
        for k, moved in enumerate(_units(x[:6], frame, tip, PLACEMENT in some)):
            for axis, value in enumerate(moved):
                moves[:, k, axis] = value
        made |= zip(some, moves.reshape(-1, 6, 3, *shape), strict=True)
    return made


def stack(v: Vec) -> np.ndarray:
    """Stack three scalars, floats or arrays (...), to (..., 3)."""
    return np.stack(np.broadcast_arrays(*v), axis=-1)


def _together(
    whole: np.ndarray, blocks: Sequence[tuple[Scalar, ...]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return a value (N, k), and its p derivatives of k components each as one array (N, k, p)."""
    columns = np.empty((len(blocks), whole.shape[-1], *whole.shape[:-1]))
    for column, block in zip(columns, blocks, strict=True):
        for axis, component in enumerate(block):
            column[axis] = component
    return whole, np.ascontiguousarray(columns.T)
