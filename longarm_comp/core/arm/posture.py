"""The arm at given joint values: the frames of its stations, and the weight that they carry.

An arm is a chain of *stations*: the placement of the base, the base, a bearing and a frame per
row, one at the far end of every beam element, and one for the tip and each marker.  `Chain`
knows their order; `Posture` holds their deflected frames and the masses on them.

Only weight loads the arm.  So the load at a station follows from the mass m beyond it and the
first moment S of this mass: ``force = m g`` and ``moment about p = (S - m p) x g``.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from longarm_comp.core.arm import spatial, stacked
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.parts import Beam
from longarm_comp.core.arm.spatial import IDENTITY, ZERO, Frame, Scalar, Twist, Vec

Twists = Mapping[int, Twist]
_Made = TypeVar("_Made")
LineLoads = dict[int, list[tuple[Scalar, Scalar]]]
BASE, PLACEMENT = 0, 1
"""Numbers of two stations: the base, and its placement, which is before it in the chain.

Only the twist at the placement may be large.
"""


@dataclass(frozen=True)
class Element:
    """A piece of a beam that ends at a station."""

    beam: Beam
    station: int
    axis: int  # the frame axis along the beam: 0 (x, role a) or 2 (z, role d)
    share: float  # its length as a fraction of the beam's length
    covers: tuple[Beam, ...] = ()  # later beams whose sliding bodies may lie inside this element


class _ChainRow(NamedTuple):
    """Stations of one row: its bearing (after Rz, before Tz), its frame, and its beam elements."""

    bearing: int
    frame: int
    elements_a: tuple[Element, ...]
    elements_d: tuple[Element, ...]


class Lumped(NamedTuple):
    """A mass (kg) at a point of a station (position in its frame, m)."""

    station: int
    mass: Scalar
    position: Vec


class Chain:
    """The order of an arm's stations; each beam is divided into equal elements."""

    def __init__(self, arm: Arm, elements_per_beam: int = 2) -> None:
        self.arm, self.cuts = arm, elements_per_beam
        self.rows: list[_ChainRow] = []
        numbers = itertools.count(2)

        def cut(row: int, role: str, axis: int) -> Iterator[Element]:
            beams = [b for b in arm.links if b.row == row and b.role == role]
            for k, beam in enumerate(beams):
                later = tuple(b for b in beams[k + 1 :] if b.mass_kg > 0 and b.body_length_m)
                for _ in range(elements_per_beam):
                    yield Element(beam, next(numbers), axis, 1 / elements_per_beam, later)

        for joint in arm.joints:
            along_x = tuple(cut(joint.id, "a", 0))
            bearing = next(numbers)
            along_z = tuple(cut(joint.id, "d", 2))
            self.rows.append(_ChainRow(bearing, next(numbers), along_x, along_z))
        carriers = {"": arm.tip.frame, **{name: m.frame for name, m in arm.markers.items()}}
        self.spots = {name: next(numbers) for name in carriers}
        self.carriers = {self.spots[name]: self.frame_station(f) for name, f in carriers.items()}
        self.stations = next(numbers)
        self.mixing, self.offset = arm.mixing
        self._coupled = {
            joint: tuple((row, float(w)) for row, w in enumerate(weights, 1) if w != 0.0)
            for joint, weights in zip(arm.commanded, self.mixing.T, strict=True)
        }

    @cached_property
    def elements(self) -> tuple[Element, ...]:
        """The elements of all beams, from the base to the tip."""
        return tuple(e for row in self.rows for e in row.elements_a + row.elements_d)

    @cached_property
    def axes(self) -> dict[int, int]:
        """The axis along its beam of every element, by station."""
        return {e.station: e.axis for e in self.elements}

    def frame_station(self, row: int) -> int:
        """Return the station of row `row`'s frame; row 0 is the base."""
        return BASE if row == 0 else self.rows[row - 1].frame

    def values(self, q: Sequence[Scalar]) -> list[Scalar]:
        """Compute the joint value of every row (rad or m) from q (passive joints follow)."""
        values: list[Scalar] = []
        for weights, offset in zip(self.mixing, self.offset, strict=True):
            value: Scalar = float(offset)
            for weight, qi in zip(weights, q, strict=True):
                if weight != 0.0:
                    value = value + (qi if weight == 1.0 else float(weight) * qi)
            values.append(value)
        return values

    def coupled_rows(self, joint: int) -> tuple[tuple[int, float], ...]:
        """Return the rows that a joint (row id) moves, each with its motion per unit of the joint.

        For a joint that is not commanded it is its own row alone, with 1.
        """
        return self._coupled.get(joint, ((joint, 1.0),))

    @cached_property
    def own_axes(self) -> list[tuple[int, int, int, float]]:
        """The axes of the commanded joints.

        Each is the row id, the station of the axis, the index of the motion in a twist (2: along
        z, 5: about z), and the size of this motion per unit of the joint.
        """
        made = []
        for row in self.arm.commanded:
            moved = dict(self.coupled_rows(row))
            at = row if row in moved else next(iter(moved))
            axis = 2 if self.arm.joints[at - 1].type == "prismatic" else 5
            made.append((row, self.rows[at - 1].bearing, axis, moved[at]))
        return made

    @cached_property
    def tilted_at(self) -> tuple[float, ...]:
        """Per row, the point about which its axis tilts: its z (m) in the frame of the row before.

        It is 0, the origin of that frame, unless the origin is farther away than the arm is long:
        rows of nearly parallel axes put it anywhere along the axis.  Then the point is the one on
        the axis that is closest to the point of the row before, so a tilt has the same effect in
        whatever way the rows are written.
        """
        frames, _ = self.place(tuple(self.arm.mid.tolist()), {})
        at, length, off = np.array(frames[BASE].p), 0.0, []
        for station in (BASE, *(row.frame for row in self.rows)):
            origin, axis = np.array(frames[station].p), np.array(frames[station].a)
            along = float((at - origin) @ axis)
            length += float(np.linalg.norm(origin + along * axis - at))
            at = origin + along * axis
            off.append(along)
        length += float(np.linalg.norm(np.array(frames[self.spots[""]].p) - at))
        return tuple(along if abs(along) > length else 0.0 for along in off[:-1])

    def place(self, q: Sequence[Scalar], twists: Twists) -> tuple[list[Frame], list[Scalar]]:
        """Return every station's frame in the base frame (m), and every element's length (m).

        Both are lists by station.  The twists are composed inside the chain (the paper's Eq. 1-2,
        exactly): ``T_1 exp(x_1) T_2 exp(x_2) ...``.

        Args:
            q: n commanded joints, rad and m.
            twists: by station.
        """
        arm = self.arm
        frames: list[Frame] = [IDENTITY] * self.stations
        lengths: list[Scalar] = [0.0] * self.stations

        moved = stacked.exps({s: t for s, t in twists.items() if s != PLACEMENT})
        if PLACEMENT in twists:
            moved[PLACEMENT] = spatial.exp_large(twists[PLACEMENT])

        def deflect(frame: Frame, station: int) -> Frame:
            if station in moved:
                frame = frame @ moved[station]
            frames[station] = frame
            return frame

        def run(frame: Frame, elements: tuple[Element, ...], axis: int, size: Scalar) -> Frame:
            sign = sign_of(size)
            fixed = sum(e.share * e.beam.length_m for e in elements if e.beam.length_m != "rest")
            left = size
            for e in elements:
                whole = e.beam.length_m
                length = e.share * (sign * size - fixed if whole == "rest" else float(whole))
                lengths[e.station] = sign * length
                frame = deflect(frame.along(axis, sign * length), e.station)
                left = left - sign * length
            if any(e.beam.length_m == "rest" for e in elements):
                return frame
            return frame if type(left) is float and left == 0.0 else frame.along(axis, left)

        frame = deflect(deflect(arm.base.frame(), PLACEMENT), BASE)
        for joint, row, value in zip(arm.joints, self.rows, self.values(q), strict=True):
            if joint.type == "fixed" and joint.pose is not None:
                frame = deflect(frame @ joint.pose.frame(), row.bearing)
            else:
                theta: Scalar = math.radians(joint.theta_offset_deg)
                d: Scalar = joint.d_m
                if joint.type == "revolute":
                    theta = theta + value
                elif joint.type == "prismatic":
                    d = d + value
                frame = frame.turned_x(math.radians(joint.alpha_deg))
                frame = run(frame, row.elements_a, 0, joint.a_m)
                frame = deflect(frame.turned_z(theta), row.bearing)
                frame = run(frame, row.elements_d, 2, d)
            frame = deflect(frame, row.frame)
        for spot, carrier in self.carriers.items():
            deflect(frames[carrier], spot)
        return frames, lengths


@dataclass(frozen=True)
class Posture:
    """The arm at given joint values, or at N of them (scalars are then (N,) arrays)."""

    chain: Chain
    q: tuple[Scalar, ...]  # n commanded joints (rad, m)
    context: Context
    frames: list[Frame]  # every station's in the base frame (m)
    lengths: list[Scalar]  # signed, of the element that ends at each station (m); 0 at others
    gravity: Vec  # in the base frame (m/s^2)
    twists: Twists = field(default_factory=dict)  # by station, as applied in `frames`
    extra: tuple[Lumped, ...] = ()  # masses that effects add
    of_lengths: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)
    """What follows from `lengths`, by name; postures of the same joints share it."""
    _made: dict[tuple[object, ...], object] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @property
    def arm(self) -> Arm:
        return self.chain.arm

    @property
    def count(self) -> int:
        """The number N of postures that its scalars hold."""
        return int(np.size(self.q[0]))

    @cached_property
    def values(self) -> list[Scalar]:
        """Joint value of every row (rad or m), including passive joints."""
        return self.chain.values(self.q)

    def station_masses(self) -> list[Lumped]:
        """Return all masses that are lumped at points; those of `line_loads` are not included."""
        made: list[Lumped] = []
        for m in self.arm.point_masses:
            at: Vec = m.position_m
            if m.position_columns is not None:
                at = tuple(map(self.context.column, m.position_columns))  # type: ignore[assignment]
            made.append(Lumped(self.frame(m.frame), m.mass_kg, at))
        payload = self.arm.payload
        if payload is not None:
            kg = self.context.payload_kg(payload.mass_kg)
            made.append(Lumped(self.frame(payload.frame), kg, payload.position_m))
        if "overhangs" not in self.of_lengths:
            self.of_lengths["overhangs"] = list(self._list_overhangs())
        return [*made, *self.of_lengths["overhangs"], *self.extra]

    @cached_property
    def line_loads(self) -> LineLoads:
        """Uniform loads by element station: mass per length (kg/m) and loaded length (m).

        The loaded length is counted back from the element's far end.  A sliding body lies in its
        own beam and, for the rest of its length, inside the beams before it.
        """
        if "line_loads" not in self.of_lengths:
            self.of_lengths["line_loads"] = self._list_line_loads()
        loads: LineLoads = self.of_lengths["line_loads"]
        return loads

    def _list_line_loads(self) -> LineLoads:
        loads: LineLoads = {}
        for elements in (some for r in self.chain.rows for some in (r.elements_a, r.elements_d)):
            for k, e in enumerate(elements):
                length = spatial.absolute(self.lengths[e.station])
                own = loads.setdefault(e.station, [])
                if e.beam.mass_kg > 0 and e.beam.body_length_m is None:
                    own.append((e.beam.mass_kg / float(e.beam.length_m), length))
                for beam in (e.beam, *e.covers):
                    if beam.mass_kg > 0 and beam.body_length_m is not None:
                        reach = beam.body_length_m - self._measure_beyond(elements, k, beam)
                        reach = spatial.minimum(spatial.maximum(reach, 0.0), length)
                        own.append((beam.mass_kg / beam.body_length_m, reach))
        return loads

    def _list_overhangs(self) -> Iterator[Lumped]:
        """Yield the masses of sliding bodies as far as they reach behind their row's first beam."""
        for number, row in enumerate(self.chain.rows):
            before = self.chain.frame_station(number)
            for elements, station in ((row.elements_a, before), (row.elements_d, row.bearing)):
                for beam in {e.beam.name: e.beam for e in elements}.values():
                    if beam.mass_kg == 0 or beam.body_length_m is None:
                        continue
                    behind = beam.body_length_m - self._measure_beyond(elements, -1, beam)
                    behind = spatial.maximum(behind, 0.0)
                    if type(behind) is float and behind == 0.0:
                        continue
                    x, z = (-0.5 * behind if elements[0].axis == k else 0.0 for k in (0, 2))
                    yield Lumped(station, beam.mass_kg / beam.body_length_m * behind, (x, 0.0, z))

    def _measure_beyond(self, elements: tuple[Element, ...], k: int, beam: Beam) -> Scalar:
        """Return the length (m) from the far end of element k (-1: the start) to that of `beam`."""
        last = max(j for j, e in enumerate(elements) if e.beam is beam)
        beyond: Scalar = 0.0
        for e in elements[k + 1 : last + 1]:
            beyond = beyond + spatial.absolute(self.lengths[e.station])
        return beyond

    @cached_property
    def carried_masses(self) -> tuple[list[Scalar], list[Vec]]:
        """Mass (kg) at and beyond every station, and its first moment in the base frame (kg m).

        The mass of a beam element counts at the stations before its end, not at its end.
        """
        own: dict[int, list[Lumped]] = {}
        for lump in self.station_masses():
            own.setdefault(lump.station, []).append(lump)
        mass: Scalar = 0.0
        moment: Vec = ZERO
        masses: list[Scalar] = [0.0] * self.chain.stations
        moments: list[Vec] = [ZERO] * self.chain.stations
        axes, line_loads = self.chain.axes, self.line_loads
        for station in range(self.chain.stations - 1, -1, -1):
            frame = self.frames[station]
            for lump in own.get(station, ()):
                mass = mass + lump.mass
                there = frame.transform(lump.position)
                moment = spatial.add(moment, spatial.scale(lump.mass, there))
            masses[station], moments[station] = mass, moment
            for density, length in line_loads.get(station, ()):
                m = density * length
                back = -0.5 * sign_of(self.lengths[station]) * length
                centre = spatial.add(frame.p, spatial.scale(back, frame[axes[station]]))
                mass = mass + m
                moment = spatial.add(moment, spatial.scale(m, centre))
        return masses, moments

    def once(self, key: tuple[object, ...], make: Callable[[], _Made]) -> _Made:
        """Return the result of `make`, which is called only once per key for this posture."""
        if key not in self._made:
            self._made[key] = make()
        return cast(_Made, self._made[key])

    def gravity_in(self, station: int) -> Vec:
        """Return gravity in a station's axes (m/s^2)."""
        return self.once(("gravity", station), lambda: self.frames[station].unrotate(self.gravity))

    def force(self, station: int) -> Vec:
        """Return the weight of everything carried at a station, in its axes (N)."""
        return self._loads_at(station)[1]

    def moment(self, station: int) -> Vec:
        """Return the moment (N m) of that weight, about the station's origin and in its axes."""
        return self._loads_at(station)[2]

    def _loads_at(self, station: int) -> tuple[Vec, Vec, Vec]:
        mass, first = self.carried_masses
        carried = self.frames[station], mass[station], first[station], self.gravity
        return self.once(("loads", station), lambda: compute_loads(*carried))

    def bearing(self, row: int) -> int:
        """Return the station of a row's bearing, whose z axis is the axis of the joint."""
        return self.chain.rows[row - 1].bearing

    def frame(self, row: int) -> int:
        """Return the station of a row's frame; row 0 is the base."""
        return self.chain.frame_station(row)

    def spot(self, marker: str = "") -> int:
        """Return the station, without mass, of a marker's offset; without a name the tip's."""
        return self.chain.spots[marker]


def sign_of(length: Scalar) -> float:
    """Return -1.0 for a negative length of an element that is constant, else 1.0."""
    return -1.0 if type(length) is float and length < 0 else 1.0


def compute_loads(frame: Frame, mass: Scalar, first: Vec, gravity: Vec) -> tuple[Vec, Vec, Vec]:
    """Compute gravity (m/s^2), weight (N) and moment (N m) in a frame's axes, about its origin.

    Args:
        mass: carried mass, kg.
        first: first moment of this mass in the base frame, kg m.
        gravity: in the base frame, m/s^2.
    """
    felt = frame.unrotate(gravity)
    lever = spatial.sub(first, spatial.scale(mass, frame.p))
    return felt, spatial.scale(mass, felt), frame.unrotate(spatial.cross(lever, gravity))
