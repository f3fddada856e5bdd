"""How the tip, and what a sensor reports of it, moves with each parameter of a model.

The arm side moves the tip: by Eq. (5) a shift of the point and a turn of its axes.  The camera
side moves what is reported of a tip that stays.  A kind of measurement
(`core/data/measurement.py`) makes its equations of both.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.posture import PLACEMENT, Posture, Twists
from longarm_comp.core.arm.spatial import IDENTITY, Frame, Scalar, Vec
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.model import encoders
from longarm_comp.core.model.encoders import Parts

_H = 1e-3
"""Step (of a unit parameter, of a rad) of differences through the measuring side."""


class _Sensor(Protocol):
    """What reports the tip: a model's measuring side."""

    def seen(self, point: Vec, context: Context, kind: str = "position") -> Vec: ...

    def seen_axes(self, tip: Frame, context: Context) -> Frame: ...

    def read(self, value: Scalar, row: int) -> Scalar: ...


@dataclass(frozen=True)
class _Moved:
    """A change of the arm: shift of the tip (m) and turn of its axes (rad), in the base frame."""

    shift: Vec
    turn: Vec


@dataclass(frozen=True)
class Reseen:
    """A change of the measuring side: ``per`` times the difference of two sensors' reports."""

    raised: _Sensor
    lowered: _Sensor
    per: float
    sees: frozenset[str]


class TwistChange(NamedTuple):
    """A change of effects' twists: ``per`` times the difference of two."""

    raised: Parts
    lowered: Parts
    per: float


@dataclass(frozen=True)
class SeenJoints:
    """What the joints' encoders see at N postures.

    Attributes:
        posture: the arm there.
        effects: all of the arm's side.
        ends: a change of these a parameter.
    """

    posture: Posture
    effects: Sequence[Effect]
    ends: Sequence[TwistChange]

    @cached_property
    def now(self) -> list[Scalar]:
        """n scalars, rad or m."""
        parts = [(e, e.twists(self.posture)) for e in self.effects]
        off = encoders.seen(self.posture.chain, parts)
        return [q + by for q, by in zip(self.posture.q, off, strict=True)]

    @cached_property
    def changes(self) -> list[list[Scalar]]:
        """n scalars a parameter, per unit of it."""
        made = []
        for end in self.ends:
            up, down = (encoders.seen(self.posture.chain, part) for part in end[:2])
            made.append([end.per * (a - b) for a, b in zip(up, down, strict=True)])
        return made


@dataclass(frozen=True)
class TipMotion:
    """The tip at N postures and its change by each of p parameters.

    Attributes:
        sensor: the model's measuring side.
        frame: pose of the tip in the base frame.
        context: circumstances of the postures.
        changes: one per parameter.
        joints: where every joint's encoder sees it, and its change by each parameter of the arm's
            side, both when they are asked for.
    """

    sensor: _Sensor
    frame: Frame
    context: Context
    changes: Sequence[_Moved | Reseen]
    joints: SeenJoints

    def point(self, kind: str = "position") -> tuple[np.ndarray, np.ndarray]:
        """Reported point (N, 3) in m and its derivative (N, 3, p)."""
        seen = self.sensor.seen(self.frame.p, self.context, kind)
        free = seen is self.frame.p
        blocks = [self._point_change(change, kind, free) for change in self.changes]
        return _together(seen, blocks)

    def _point_change(self, change: _Moved | Reseen, kind: str, free: bool) -> Vec:
        tip = self.frame.p
        if isinstance(change, Reseen):
            if kind not in change.sees:
                return spatial.ZERO
            ends = [s.seen(tip, self.context, kind) for s in (change.raised, change.lowered)]
            return spatial.scale(change.per, spatial.sub(ends[0], ends[1]))
        if free:
            return change.shift
        up = self.sensor.seen(spatial.add(tip, spatial.scale(_H, change.shift)), self.context, kind)
        down = self.sensor.seen(
            spatial.sub(tip, spatial.scale(_H, change.shift)), self.context, kind
        )
        return spatial.scale(0.5 / _H, spatial.sub(up, down))

    def read(self, joint: int, row: int) -> tuple[np.ndarray, np.ndarray]:
        """Reading (N, 1) of a joint's encoder, rad or m, and its derivative (N, 1, p).

        Args:
            joint: position among the commanded joints.
            row: its row in the arm.
        """
        at, sensor = self.joints.now[joint], self.sensor
        gain = (sensor.read(at + _H, row) - sensor.read(at - _H, row)) * (0.5 / _H)
        moves = iter(self.joints.changes)
        each = [
            gain * next(moves)[joint]
            if isinstance(change, _Moved)
            else change.per * (change.raised.read(at, row) - change.lowered.read(at, row))
            for change in self.changes
        ]
        whole = np.broadcast_to(sensor.read(at, row), np.shape(stack(self.frame.p))[:-1])
        columns = np.empty((*whole.shape, 1, len(each)))
        for k, column in enumerate(each):
            columns[..., 0, k] = column
        return whole[..., None], columns

    def pull(self, kind: str) -> np.ndarray:
        """(N, 3, 3) derivative of the reported point by the tip's position."""
        ends = [
            [self.sensor.seen(spatial.add(self.frame.p, spatial.scale(s, axis)), self.context, kind)
             for s in (_H, -_H)]
            for axis in IDENTITY[:3]
        ]  # fmt: skip
        return _together(
            self.frame.p, [spatial.scale(0.5 / _H, spatial.sub(up, down)) for up, down in ends]
        )[1]

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Reported axes of the tip (N, 3, 3) and their turn (rad) by each parameter (N, 3, p).

        How a bias turns the axes may depend on where the tip is; that part is left out.
        """
        seen = self.sensor.seen_axes(self.frame, self.context)
        gain = [self._report_of_turn(axis) for axis in IDENTITY[:3]]
        blocks = [self._turn(change, gain) for change in self.changes]
        rotation = seen.matrix()[..., :3, :3]
        return rotation, _together(self.frame.p, blocks)[1]

    def _report_of_turn(self, axis: Vec) -> Vec:
        """Turn of the reported axes as the tip turns about an axis of the base, per rad."""
        if self.sensor.seen_axes(IDENTITY, self.context) is IDENTITY:
            return axis
        ends = []
        for step in (_H, -_H):
            turn = spatial.exp((0.0, 0.0, 0.0, *spatial.scale(step, axis)))
            n, o, a = (turn.rotate(v) for v in self.frame[:3])
            tip = Frame(n, o, a, self.frame.p)
            ends.append(self.sensor.seen_axes(tip, self.context))
        return spatial.scale(0.5 / _H, spatial.turned(ends[0], ends[1]))

    def _turn(self, change: _Moved | Reseen, gain: list[Vec]) -> Vec:
        if isinstance(change, _Moved):
            turned = [spatial.scale(w, g) for w, g in zip(change.turn, gain, strict=True)]
            return spatial.add(spatial.add(turned[0], turned[1]), turned[2])
        if "orientation" not in change.sees:
            return spatial.ZERO
        ends = [s.seen_axes(self.frame, self.context) for s in (change.raised, change.lowered)]
        return spatial.scale(change.per, spatial.turned(ends[0], ends[1]))


def summed(parts: Iterable[Twists]) -> Twists:
    """Sum of twists by station."""
    total: dict[int, spatial.Twist] = {}
    for part in parts:
        for station, twist in part.items():
            held = total.get(station)
            total[station] = twist if held is None else spatial.add_twists(held, twist)
    return total


def moved(
    posture: Posture, tip: Vec, total: Twists, ends: Sequence[TwistChange], turns: bool
) -> list[_Moved]:
    """Eq. (5): the tip's motion under changes of twists.

    Its point moves by ``sum_i R_i (d_i + delta_i x p_i)``, its axes by ``sum_i R_i delta_i``.
    A change is taken about the present twist of the station. This is exact also for a large
    twist, as of a displaced base. The frames after it are kept.
    """
    at: dict[int, tuple[list[Vec], list[Vec]]] = {}
    made = []
    for e in ends:
        shift, turn = [0.0] * 3, [0.0] * 3
        raised, lowered = (summed(twists for _, twists in part) for part in e[:2])
        for station in sorted({*raised, *lowered}):
            up = raised.get(station, spatial.ZERO_TWIST)
            down = lowered.get(station, spatial.ZERO_TWIST)
            for k, (a, b) in enumerate(zip(up, down, strict=True)):
                if a is b or (type(a) is float and type(b) is float and a == b):
                    continue
                if station not in at:
                    at[station] = _units(posture, tip, station, total)
                per, (turned, shifted) = e.per * (a - b), at[station]
                _add(shift, per, turned[k] if k < 3 else shifted[k - 3])
                if turns and k >= 3:
                    _add(turn, per, turned[k - 3])
        made.append(_Moved(tuple(shift), tuple(turn)))  # type: ignore[arg-type]
    return made


def _units(posture: Posture, tip: Vec, station: int, total: Twists) -> tuple[list[Vec], list[Vec]]:
    """Turn of the tip's axes by each rotation of a station's twist, and shift of the tip by it."""
    frame, now = posture.frames[station], total.get(station, spatial.ZERO_TWIST)
    here = frame.unrotate(spatial.sub(tip, frame.p))
    turned, shifted = spatial.tangent(now, here, large=station == PLACEMENT)
    return [frame.rotate(v) for v in turned], [frame.rotate(v) for v in shifted]


def _add(total: list[Scalar], times: Scalar, v: Vec) -> None:
    for axis in range(3):
        if type(v[axis]) is not float or v[axis] != 0.0:
            here, held = times * v[axis], total[axis]
            total[axis] = here if type(held) is float and held == 0.0 else held + here


def stack(v: Vec) -> np.ndarray:
    """Three scalars -> (..., 3)."""
    return np.stack(np.broadcast_arrays(*v), axis=-1)


def _together(point: Vec, blocks: Sequence[Vec]) -> tuple[np.ndarray, np.ndarray]:
    """The point, (N, 3), and the blocks in its shape, (N, 3, p)."""
    whole = stack(point)
    columns = np.empty((len(blocks), 3, *whole.shape[:-1]))
    for column, block in zip(columns, blocks, strict=True):
        for axis, component in enumerate(block):
            column[axis] = component
    return whole, np.ascontiguousarray(columns.T)
