"""Quantities, by name, on which the function of a discovered effect may depend.

| name | quantity | unit |
|---|---|---|
| `q2` | position of commanded joint 2 | rad, m |
| `load_2` | gravity torque about, or force along, commanded joint 2 | N m, N |
| `sum_loads` | sum of the absolute torques of the turning commanded joints | N m |
| `moment_3_x` | moment at the bearing of row 3 about its x axis (row 0: the base) | N m |
| `gravity_3_x` | share of gravity along x of row 3's axes (row 0: the base) | 1 |
| `distance_2_5` | distance between the bearings of rows 2 and 5 | m |
| `side_2` | side from which commanded joint 2 arrived, -1 or +1; 0 unknown | 1 |
| `way_2` | displacement of commanded joint 2 since it stood or reversed; 0 unknown | rad, m |
| `warmth` | temperature above the arm's reference | K |
| `seen_x` | coordinate of the seen point in the base frame (measuring side only) | m |
| any other | a recorded column of that name: `t_s`, `pump_bar` | of the column |
"""

import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple

import numpy as np

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import ORDER, Context
from longarm_comp.core.arm.posture import BASE, Posture
from longarm_comp.core.arm.spatial import Scalar, Vec
from longarm_comp.core.effects.joint_term import joint_load

AXES = ("x", "y", "z")


class SeenPoint(NamedTuple):
    """The input of a measuring-side function: the seen point (m) and the circumstances."""

    point: Vec
    context: Context


@dataclass(frozen=True)
class Quantity(ABC):
    """A quantity of a posture or of a seen point."""

    pattern: ClassVar[str]  # regular expression of its names
    si: ClassVar[str] = "1"  # its SI unit; ``1`` for none
    plain = True  # whether a cause is likely to depend on it directly
    inputs: ClassVar[tuple[str, ...]] = ()  # fields of the circumstances that it reads
    resolution: ClassVar[float] = 0.0  # range below which it varies only by the arm's tolerance

    numbers: tuple[int, ...] = ()  # in its name: joints, rows
    axis: int = 0  # 0, 1 or 2 for the axis in its name; 0 if there is none

    @abstractmethod
    def read(self, at: Any) -> Scalar:
        """Return its value, in `unit`, at a `Posture` or (on the measuring side) a `SeenPoint`."""

    def exists(self, arm: Arm) -> bool:
        """Tell whether an arm has this quantity."""
        return True

    def unit(self, arm: Arm) -> str:
        """Return its SI unit on an arm; ``1`` for none."""
        return self.si


class OfPosture(Quantity):
    """A quantity of the arm at a posture."""


class _OfJoint(OfPosture):
    """A quantity of one commanded joint; `of_slide` is its unit if the joint is prismatic."""

    of_slide = "1"

    @property
    def joint(self) -> int:
        """The index (0-based) of its commanded joint."""
        return self.numbers[0] - 1

    def exists(self, arm: Arm) -> bool:
        return 0 <= self.joint < arm.n

    def unit(self, arm: Arm) -> str:
        return self.of_slide if arm.slides[self.joint] else self.si


class JointPosition(_OfJoint):
    pattern = r"q(\d+)"
    si, of_slide = "rad", "m"

    def read(self, posture: Posture) -> Scalar:
        return posture.q[self.joint]


class JointLoad(_OfJoint):
    pattern = r"load_(\d+)"
    si, of_slide = "N m", "N"

    def read(self, posture: Posture) -> Scalar:
        return joint_load(posture, posture.arm.commanded[self.joint])


class OfHistory(_OfJoint):
    """A history field of a commanded joint."""

    def read(self, posture: Posture) -> Scalar:
        return posture.context.of_joint(self.inputs[0], self.joint)[0]


class JointSide(OfHistory):
    pattern = r"side_(\d+)"
    inputs = ("approach",)


class JointWay(OfHistory):
    pattern = r"way_(\d+)"
    si, of_slide = "rad", "m"
    inputs = ("last_way",)


class LoadSum(OfPosture):
    pattern = r"sum_loads"
    si = "N m"

    def exists(self, arm: Arm) -> bool:
        return bool(_turning(arm))

    def read(self, posture: Posture) -> Scalar:
        loads = (joint_load(posture, row) for row in _turning(posture.arm))
        return sum(map(spatial.absolute, loads), 0.0)


class Warmth(OfPosture):
    pattern = r"warmth"
    si = "K"
    inputs = ("temperature_c",)

    def read(self, posture: Posture) -> Scalar:
        return posture.context.column("temperature_c") - posture.arm.reference_temperature_c


class _OfRow(OfPosture):
    """A quantity in the axes of one row's bearing, or of the base."""

    def exists(self, arm: Arm) -> bool:
        return 0 <= self.numbers[0] <= len(arm.joints)


class Moment(_OfRow):
    pattern = r"moment_(\d+)_([xyz])"
    si = "N m"
    plain = False

    def read(self, posture: Posture) -> Scalar:
        return posture.moment(_bearing(posture, self.numbers[0]))[self.axis]


class Gravity(_OfRow):
    pattern = r"gravity_(\d+)_([xyz])"
    plain = False

    def read(self, posture: Posture) -> Scalar:
        size = float(np.linalg.norm(posture.arm.gravity_mps2))
        station = _bearing(posture, self.numbers[0])
        return posture.gravity_in(station)[self.axis] * (1.0 / max(size, 1e-9))


class Span(OfPosture):
    pattern = r"distance_(\d+)_(\d+)"
    si = "m"
    resolution = 1e-3  # the tolerance of a row's lengths (`dh_error`)
    plain = False

    def exists(self, arm: Arm) -> bool:
        first, last = self.numbers
        return 0 <= first < last <= len(arm.joints)

    def read(self, posture: Posture) -> Scalar:
        first, last = (posture.frames[_bearing(posture, row)].p for row in self.numbers)
        way = spatial.sub(last, first)
        # m^2: keeps the root differentiable where two bearings coincide
        return spatial.sqrt(spatial.dot(way, way) + 1e-18)


class SeenCoordinate(Quantity):
    pattern = r"seen_([xyz])"
    si = "m"

    def read(self, seen: SeenPoint) -> Scalar:
        return seen.point[self.axis]


@dataclass(frozen=True)
class Recorded(Quantity):
    """A recorded column."""

    pattern = r"[A-Za-z]\w*"

    column: str = ""

    @property
    def plain(self) -> bool:  # type: ignore[override]
        """False only for the pose number, because it causes nothing by itself."""
        return self.column != ORDER

    def unit(self, arm: Arm) -> str:
        return _UNITS.get(self.column, f"[{self.column}]")

    @property
    def inputs(self) -> tuple[str, ...]:  # type: ignore[override]
        return (self.column,)

    def read(self, at: Posture | SeenPoint) -> Scalar:
        return at.context.column(self.column)


_UNITS = {"t_s": "s", "temperature_c": "K", "payload_kg": "kg"}
_OF_ARM = (JointPosition, JointLoad, JointSide, JointWay, LoadSum, Warmth, Moment, Gravity, Span)


@lru_cache(maxsize=4096)
def quantity(name: str) -> Quantity | None:
    """Return the quantity with a name; None if the name is not valid."""
    for kind in (*_OF_ARM, SeenCoordinate):
        found = re.fullmatch(kind.pattern, name)
        if found:
            letters = [text for text in found.groups() if text in AXES]
            numbers = tuple(int(text) for text in found.groups() if text not in AXES)
            return kind(numbers, AXES.index(letters[0]) if letters else 0)
    return Recorded(column=name) if re.fullmatch(Recorded.pattern, name) else None


def is_column(name: str) -> bool:
    """Tell whether this name means a recorded column, and no other quantity."""
    return isinstance(quantity(name), Recorded)


def _turning(arm: Arm) -> list[int]:
    return [row for row in arm.commanded if arm.joints[row - 1].type == "revolute"]


def _bearing(posture: Posture, row: int) -> int:
    return BASE if row == 0 else posture.bearing(row)
