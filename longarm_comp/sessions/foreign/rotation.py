"""Orientations of other programs, in the convention that the user names, as quaternions."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.errors import InputError

_QUATERNIONS = {"xyzw": (0, 1, 2, 3), "wxyz": (1, 2, 3, 0)}
_ROTATION_VECTOR = "rotvec"
ALLOWED = (
    "CONVENTION:COLUMNS with xyzw or wxyz and four columns; rotvec and three; or Euler angles and "
    "three: xyz about the fixed x, y, then z (roll, pitch, yaw), ZYX about the turned z, y, x; "
    "with a minus before it where the columns hold the base in the tool"
)
_EULER = re.compile(r"(?!.*(.)\1)([xyzXYZ])([xyzXYZ])([xyzXYZ])")
UNIT_LENGTH = 1e-2


@dataclass(frozen=True)
class Rotation:
    """A convention and the columns that are in it: ``wxyz:q0,q1,q2,q3``, ``ZYX:A,B,C``.

    Attributes:
        convention: a key of `_QUATERNIONS`, `_ROTATION_VECTOR`, or Euler axes as scipy names them
            (lower case fixed, upper case turned).
        columns: names in the file.
        inverse: the columns hold the base's orientation in the tool's frame.
    """

    convention: str
    columns: tuple[str, ...]
    inverse: bool

    @classmethod
    def parse(cls, text: str, where: str) -> Rotation:
        """From ``CONVENTION:COLUMNS``. Raises InputError."""
        convention, colon, names = text.partition(":")
        inverse, convention = convention.startswith("-"), convention.removeprefix("-")
        columns = tuple(name.strip() for name in names.split(","))
        euler = _EULER.fullmatch(convention) and convention in (
            convention.lower(),
            convention.upper(),
        )
        count = 4 if convention in _QUATERNIONS else 3
        known = convention in _QUATERNIONS or convention == _ROTATION_VECTOR or euler
        if not colon or not known or len(columns) != count or not all(columns):
            raise InputError(where, "--rotation", text, ALLOWED)
        return cls(convention, columns, inverse)

    @property
    def angles(self) -> bool:
        """Whether the columns are angles, with a unit."""
        return self.convention not in _QUATERNIONS

    def quaternions(self, values: np.ndarray) -> np.ndarray:
        """(N, 4) x, y, z, w of unit length from (N, 3 or 4) values (rad); NaN rows stay NaN.

        Raises:
            ValueError: a quaternion is not of length 1.
        """
        from scipy.spatial.transform import Rotation as Turn

        made = np.full((len(values), 4), np.nan)
        told = ~np.isnan(values).any(axis=1)
        if not told.any():
            return made
        held = values[told]
        if self.convention in _QUATERNIONS:
            held = held[:, _QUATERNIONS[self.convention]]
            off = np.abs(np.linalg.norm(held, axis=1) - 1)
            if off.max() > UNIT_LENGTH:
                row = int(np.flatnonzero(told)[int(off.argmax())])
                raise ValueError(f"row {row + 1}: length {np.linalg.norm(values[row]):.4g}")
            turn = Turn.from_quat(held)
        elif self.convention == _ROTATION_VECTOR:
            turn = Turn.from_rotvec(held)
        else:
            turn = Turn.from_euler(self.convention, held)
        quaternion = (turn.inv() if self.inverse else turn).as_quat()
        made[told] = np.where(quaternion[:, 3:] < 0, -quaternion, quaternion)
        return made
