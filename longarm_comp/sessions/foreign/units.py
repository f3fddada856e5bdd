"""Units, times and orientations of other programs."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from longarm_comp.core.errors import InputError

_STAMP = re.compile(r"(19|20)\d{12}(\.0*)?")
_PLAIN = re.compile(r"[-+]?[\d.,]+([eE][-+]?\d+)?")
_OF_DAY = re.compile(r"\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?")


def seconds(texts: Sequence[str], breaks: Sequence[int] = ()) -> np.ndarray | None:
    """Return (N,) seconds since the first of N wall-clock times; None if a text is not a time.

    A time of day that falls by more than 12 hours is of the next day; if it is the first time of a
    further file, whose places are `breaks`, any fall is.
    """
    import pandas as pd

    texts = [text.strip() for text in texts]
    try:
        if all(map(_STAMP.fullmatch, texts)):
            when = pd.to_datetime(pd.Series([t[:14] for t in texts]), format="%Y%m%d%H%M%S")
        elif any(map(_PLAIN.fullmatch, texts)):
            return None
        elif all(map(_OF_DAY.fullmatch, texts)):
            whole = [f"{t}:00" if t.count(":") == 1 else t.replace(",", ".") for t in texts]
            passed = pd.to_timedelta(pd.Series(whole)).dt.total_seconds().to_numpy()
            least = np.full(len(passed), 12 * 3600.0)
            least[list(breaks)] = 0.0
            days = np.cumsum(np.diff(passed, prepend=passed[:1]) < -least)
            return np.asarray(passed - passed[0] + 86400.0 * days)
        else:
            when = pd.to_datetime(pd.Series(texts), format="mixed", utc=True)
    except (ValueError, OverflowError):
        return None
    if when.isna().any():
        return None
    return (when - when.iloc[0]).dt.total_seconds().to_numpy()


_QUATERNIONS = {"xyzw": (0, 1, 2, 3), "wxyz": (1, 2, 3, 0)}
ROTATION_VECTOR, MATRIX = "rotvec", "matrix"
ALLOWED = (
    "CONVENTION:COLUMNS with xyzw or wxyz and four columns; matrix and nine, row by row; rotvec "
    "and three; or Euler angles and "
    "three: xyz about the fixed x, y, then z (roll, pitch, yaw), ZYX about the turned z, y, x; "
    "with a minus before it where the columns hold the base in the tool"
)
_EULER = tuple(
    order
    for axes in product("xyz", repeat=3)
    if axes[0] != axes[1] != axes[2]
    for order in ("".join(axes), "".join(axes).upper())
)
CONVENTIONS = {3: (ROTATION_VECTOR, *_EULER), 4: tuple(_QUATERNIONS), 9: (MATRIX,)}
"""Conventions by their number of columns."""
UNIT_LENGTH = 1e-2
"""Largest error of a quaternion's length, and of R R^T - I: numbers may have three digits only."""


@dataclass(frozen=True)
class Rotation:
    """A convention and the columns that are in it: ``wxyz:q0,q1,q2,q3``, ``ZYX:A,B,C``.

    Attributes:
        convention: one of `CONVENTIONS`; empty if not known. Euler axes are named as in scipy:
            lower case for fixed axes, upper case for rotating ones.
        columns: names of the columns.
        inverse: whether the columns hold the base's orientation in the tool's frame.
    """

    convention: str
    columns: tuple[str, ...]
    inverse: bool = False

    @classmethod
    def parse(cls, text: str, where: str) -> Rotation:
        """Read ``CONVENTION:COLUMNS``. Raises InputError."""
        convention, colon, names = text.partition(":")
        inverse, convention = convention.startswith("-"), convention.removeprefix("-")
        columns = tuple(name.strip() for name in names.split(","))
        known = convention in CONVENTIONS.get(len(columns), ())
        if not colon or not known or not all(columns):
            raise InputError(where, "--rotation", text, ALLOWED)
        return cls(convention, columns, inverse)

    @property
    def spelt(self) -> str:
        """The convention as the user writes it, with a minus if inverse, without the columns."""
        return "-" * self.inverse + self.convention

    @property
    def angles(self) -> bool:
        """True if the columns are three numbers in a unit of angle."""
        return len(self.columns) == 3

    def quaternions(self, values: np.ndarray) -> np.ndarray:
        """Return unit quaternions x, y, z, w (N, 4) of values (N, 3, 4 or 9), angles in rad.

        Rows of NaN stay NaN.

        Raises:
            ValueError: a quaternion's length is not 1, a matrix is no rotation, or a row is
                partly NaN.
        """
        from scipy.spatial.transform import Rotation as Turn

        made = np.full((len(values), 4), np.nan)
        blank = np.isnan(values)
        whole = ~blank.any(axis=1)
        if (partly := ~whole & ~blank.all(axis=1)).any():
            raise ValueError(f"row {int(partly.argmax()) + 1}: partly blank")
        if not whole.any():
            return made
        numbers = values[whole]
        if self.convention in _QUATERNIONS:
            numbers = numbers[:, _QUATERNIONS[self.convention]]
            off = np.abs(np.linalg.norm(numbers, axis=1) - 1)
            if off.max() > UNIT_LENGTH:
                row = int(np.flatnonzero(whole)[int(off.argmax())])
                raise ValueError(f"row {row + 1}: length {np.linalg.norm(values[row]):.4g}")
            turn = Turn.from_quat(numbers)
        elif self.convention == MATRIX:
            numbers = numbers.reshape(-1, 3, 3)
            off = np.abs(numbers @ np.swapaxes(numbers, 1, 2) - np.eye(3)).max(axis=(1, 2))
            if off.max() > UNIT_LENGTH or (np.linalg.det(numbers) < 0).any():
                worst = int(np.where(np.linalg.det(numbers) < 0, np.inf, off).argmax())
                row = int(np.flatnonzero(whole)[worst])
                raise ValueError(f"row {row + 1}: nine numbers that are no rotation")
            turn = Turn.from_matrix(numbers)
        elif self.convention == ROTATION_VECTOR:
            turn = Turn.from_rotvec(numbers)
        else:
            turn = Turn.from_euler(self.convention, numbers)
        made[whole] = (turn.inv() if self.inverse else turn).as_quat(canonical=True)
        return made


LENGTH, ANGLE, TIME, TEMPERATURE, MASS = "length", "angle", "time", "temperature", "mass"


@dataclass(frozen=True)
class Unit:
    """A unit: ``SI value = factor * value + offset`` (degrees Celsius for temperatures)."""

    name: str
    kind: str
    factor: float
    offset: float = 0.0
    also: str = ""  # other names of it, with blanks between


UNITS = {
    unit.name: unit
    for unit in (
        Unit("m", LENGTH, 1.0, also="metre meter"),
        Unit("cm", LENGTH, 1e-2),
        Unit("mm", LENGTH, 1e-3),
        Unit("um", LENGTH, 1e-6, also="µm μm"),
        Unit("in", LENGTH, 0.0254, also="inch inches"),
        Unit("rad", ANGLE, 1.0, also="radian radians"),
        Unit("mrad", ANGLE, 1e-3),
        Unit("deg", ANGLE, math.radians(1), also="° degree degrees"),
        Unit("arcmin", ANGLE, math.radians(1 / 60)),
        Unit("arcsec", ANGLE, math.radians(1 / 3600)),
        Unit("s", TIME, 1.0, also="sec seconds"),
        Unit("ms", TIME, 1e-3, also="msec"),
        Unit("us", TIME, 1e-6, also="µs"),
        Unit("ns", TIME, 1e-9),
        Unit("min", TIME, 60.0),
        Unit("c", TEMPERATURE, 1.0, also="°c degc celsius"),
        Unit("k", TEMPERATURE, 1.0, -273.15, also="kelvin"),
        Unit("f", TEMPERATURE, 1 / 1.8, -32 / 1.8, also="°f degf"),
        Unit("kg", MASS, 1.0),
        Unit("g", MASS, 1e-3),
        Unit("lb", MASS, 0.45359237),
    )
}
_BY_WORD = {word: unit for unit in UNITS.values() for word in (unit.name, *unit.also.split())}

_BRACKETED = re.compile(r"^(.*?)\s*[\[({<]\s*([^\])}>]*)\s*[\])}>]\s*$")
_SUFFIXED = re.compile(r"^(.*\S)\s*(?:[_/,]|\s)\s*([^\s_/,]+)$")


def unit_of(text: str) -> Unit | None:
    """Return the unit that a text names, or None."""
    plain = text.strip().strip("[](){}<>").strip().lower()
    return _BY_WORD.get(plain)


def split_name(name: str) -> tuple[str, Unit | None]:
    """Split a column's name and its unit: ``q1 [deg]``, ``x_mm``, ``Time (ms)``, ``A1/deg``."""
    for pattern in (_BRACKETED, _SUFFIXED):
        found = pattern.match(name)
        unit = unit_of(found.group(2)) if found else None
        if found and unit is not None:
            return found.group(1).strip(" ,/_"), unit
    return name.strip(), None
