"""Reads targets from a CSV file (targets.csv) or the command line."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.quaternion import LENGTH_TOLERANCE
from longarm_comp.core.compensation.target_frame import BASE, FRAMES
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.csv import UNITS, XYZ, read_approach, read_further_columns
from longarm_comp.sessions.table import FARTHEST, Table, check_header, check_unknown, read_table

QUATERNION = ("qx", "qy", "qz", "qw")


@dataclass(frozen=True, eq=False)
class Targets:
    """N points or poses to reach."""

    index: np.ndarray
    xyz: np.ndarray  # (N, 3), m
    quaternion: np.ndarray  # (N, 4) x, y, z, w of unit length; NaN rows leave the orientation free
    approach: np.ndarray  # (N,) side that all joints are to arrive from, 0 for any
    columns: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Further numbers by name, (N,) each, as in `Session.columns`."""
    labels: Mapping[str, np.ndarray] = field(default_factory=dict)  # text by name, (N,) each
    source: str = "targets"
    frame: tuple[str, ...] = ()  # (N,) ``base`` or ``measured``; blank where it is not said

    def __len__(self) -> int:
        return len(self.xyz)

    def context(self, n: int) -> Context:
        """Return the circumstances of the targets for an arm of n joints, as (N,) arrays."""
        return Context(
            approach=(self.approach,) * n if self.approach.any() else (),
            columns=self.columns,
            labels=self.labels,
        )

    @property
    def points(self) -> np.ndarray:
        """The targets (N, 3), m, for a command that takes nothing but points in the base frame.

        Raises:
            InputError: a row asks for another frame, an orientation, a side or a circumstance.
        """
        asked = {
            "frame": np.array([name not in ("", BASE) for name in self.frame], bool),
            "qx": np.isfinite(self.quaternion[:, 0]),
            "approach": self.approach != 0,
            **{name: np.isfinite(values) for name, values in self.columns.items()},
            **{name: values != "" for name, values in self.labels.items()},
        }
        for name, rows in asked.items():
            if rows.any():
                row = f"row {np.argmax(rows) + 1}, {name}"
                allowed = f"x, y, z alone, in the frame {BASE}: nothing else is driven"
                raise InputError(self.source, row, "given", allowed)
        return self.xyz

    @classmethod
    def one(cls, numbers: Sequence[float]) -> Targets:
        """Read one target from the command line: x y z, or x y z qx qy qz qw.

        Raises InputError for another count, a number above `FARTHEST`, or a quaternion not of
        length 1.
        """
        values = np.asarray(numbers, dtype=float)
        if values.shape not in ((3,), (7,)) or not (np.abs(values) <= FARTHEST).all():
            allowed = f"x y z or x y z qx qy qz qw, up to {FARTHEST:g}"
            raise InputError("target", "numbers", list(numbers), allowed)
        free = np.full((1, 4), np.nan)
        single = cls(np.zeros(1, int), values[None, :3], free, np.zeros(1), source="target")
        if len(values) == 3:
            return single
        length = np.linalg.norm(values[3:])
        if abs(length - 1) > LENGTH_TOLERANCE:
            raise InputError("target", "qx qy qz qw", f"length {length:.4g}", "length 1")
        return dataclasses.replace(single, quaternion=values[None, 3:] / length)


def read_targets(path: str | Path, read: Callable[[str | Path], Table] = read_table) -> Targets:
    """Read ``x,y,z[,qx,qy,qz,qw][,frame][,temperature_c,payload_kg,t_s,approach][,index]``.

    A row with a blank quaternion leaves the orientation free; other columns are kept as
    circumstances, as in a session. ``read`` may be a reader of another table format.

    Raises:
        InputError: names file, line and column, what was found and what is allowed.
    """
    table = read(path)
    required = XYZ + (QUATERNION if any(name in table.header for name in QUATERNION) else ())
    known = (*XYZ, *QUATERNION, *UNITS, "approach", "index", "frame")
    check_header(table.where, table.header, required)
    check_unknown(table.where, table.header, known)
    xyz = table.lengths(XYZ)
    quaternion = np.full((len(table), 4), np.nan)
    if len(required) > len(XYZ):
        quaternion = table.lengths(QUATERNION, "unit quaternion", blanks=True)
        length = np.linalg.norm(quaternion, axis=1)
        good = np.isnan(quaternion).all(axis=1) | (np.abs(length - 1) <= LENGTH_TOLERANCE)
        for row in np.flatnonzero(~good).tolist():
            raise table.error(row, "qx", "a quaternion of length 1, or four blanks")
        quaternion = quaternion / length[:, None]
    approach = read_approach(table, 0)
    columns, labels = read_further_columns(table, set(known))
    index = table.integers("index") if "index" in table.cells else np.arange(len(table))
    frame = tuple(table.cells.get("frame", ()))
    for row, name in enumerate(frame):
        if name not in ("", *FRAMES):
            raise table.error(row, "frame", " or ".join(FRAMES))
    return Targets(index, xyz, quaternion, approach, columns, labels, table.where, frame)
