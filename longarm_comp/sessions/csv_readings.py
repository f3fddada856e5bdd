"""What a session's CSV measures: positions, orientations, distances, as columns.

A row measures what it holds, and blank is not measured.  A column that no row fills may be absent.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from longarm_comp.core.data.kinds import KINDS, Kind
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.names import check_header, nearest
from longarm_comp.sessions.table import Table

XYZ = KINDS["position"].cells
_FURTHER = tuple(kind for name, kind in KINDS.items() if name != "position")
READ = tuple(
    cell for kind in _FURTHER for cell in (*kind.cells, *([kind.sigma] if kind.sigma else []))
)
"""Columns of the readings beside x, y, z, and of their standard deviations."""


JOINT_READING = re.compile(r"read_q[1-9]\d*")
"""Columns of where the joints' encoders say that they stand."""


def check_measured(table: Table) -> None:
    """Raise `InputError` where a table measures nothing, or a coordinate's name is misspelt."""
    first = [(*kind.cells, kind.label)[0] for kind in _FURTHER]
    for name in XYZ:
        others = [n for n in table.header if n not in XYZ]
        if name not in table.header and nearest(name, others):
            check_header(table.where, table.header, XYZ)
    if not any(name in table.header for name in (*XYZ, *first)):
        check_header(table.where, table.header, XYZ)


def read_xyz(table: Table) -> np.ndarray:
    """(N, 3) coordinates in m, NaN where blank."""
    made = [
        table.lengths(name, blanks=True) if name in table.cells else np.full(len(table), np.nan)
        for name in XYZ
    ]
    return np.stack(made, axis=-1)


def read_readings(table: Table) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Readings of the other kinds, and their standard deviations, by kind."""
    readings, sigmas = {}, {}
    joints = (KINDS[name] for name in table.header if JOINT_READING.fullmatch(name))
    for kind in (*_FURTHER, *joints):
        if any(name in table.cells for name in kind.cells):  # none of a kind that a text measures
            readings[kind.name] = _read(table, kind)
            if kind.sigma in table.cells:
                unit = f"{kind.unit}, above 0"
                sigmas[kind.name] = table.numbers(kind.sigma, unit, True, lambda v: v > 0)
        elif kind.sigma and kind.sigma in table.cells:
            check_header(table.where, table.header, kind.cells)
    return readings, sigmas


def written_readings(session: Session) -> dict[str, Sequence[object] | np.ndarray]:
    """The columns that `read_readings` reads."""
    made: dict[str, Sequence[object] | np.ndarray] = {}
    for kind in (*_FURTHER, *(KINDS[f"read_q{k + 1}"] for k in session.read_joints)):
        if kind.name in session.readings:
            made.update(zip(kind.cells, session.readings[kind.name].T, strict=True))
        if kind.name in session.sigmas:
            made[kind.sigma] = session.sigmas[kind.name]
    return made


def _read(table: Table, kind: Kind) -> np.ndarray:
    check_header(table.where, table.header, kind.cells)
    blank = np.stack([table.blank(name) for name in kind.cells], axis=-1)
    for row in np.flatnonzero(blank.any(axis=1) & ~blank.all(axis=1)):
        column = kind.cells[int(np.argmax(blank[row]))]
        raise table.error(row, column, f"a number; {', '.join(kind.cells)} all blank where none")
    values = np.stack([table.numbers(name, kind.unit, True) for name in kind.cells], axis=-1)
    wrong, allowed = kind.wrong(values)
    for row in np.flatnonzero(wrong & ~blank.any(axis=1)):
        field = f"line {table.lines[row]}, {', '.join(kind.cells)}"
        said = ", ".join(table.cells[name][row] for name in kind.cells)
        raise InputError(table.where, field, said, allowed)
    if kind.label:
        for row in np.flatnonzero(~blank.any(axis=1) & table.blank(kind.label)):
            field = f"line {table.lines[row]}, {kind.label}"
            raise InputError(table.where, field, "blank", f"a name beside {kind.cells[0]}")
    return values
