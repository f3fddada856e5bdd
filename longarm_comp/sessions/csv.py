"""A session as a CSV file; docs/sessions.md has its columns.

Columns with other names are kept too: numbers among the session's columns, text among its labels.
A name that is close to a known one is refused, because it is probably misspelt.
"""

import math
import re
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import yaml

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import INCLINATION
from longarm_comp.core.arm.history import list_wrong_run_ups
from longarm_comp.core.arm.measuring import KnownDistance, Touches, known_distances
from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import write_text
from longarm_comp.core.yaml_file import parse_declared, range_of, read_yaml
from longarm_comp.sessions.table import (
    Table,
    check_header,
    check_unknown,
    nearest,
    read_table,
    write_table,
)

XYZ = KINDS["position"].cells
_FURTHER = tuple(kind for name, kind in KINDS.items() if name != "position")
READ = tuple(
    cell for kind in _FURTHER for cell in (*kind.cells, *([kind.sigma] if kind.sigma else []))
)
"""Columns of all measurements except x, y, z, and of their standard deviations."""


def _check_measured(table: Table, known: Collection[str]) -> None:
    """Raise `InputError` if a table measures nothing, or a coordinate's name is misspelt.

    If some of x, y, z are missing, unknown columns that may be them are refused: `zz`, `pos_y`.
    """
    first = [(*kind.cells, kind.label)[0] for kind in _FURTHER]
    others = [n for n in table.header if n not in known and not INCLINATION.match(n)]
    lacking = [name for name in XYZ if name not in table.header]
    misspelt = any(nearest(name, others) for name in lacking)
    if misspelt or not table.has((*XYZ, *first)):
        check_header(table.where, table.header, XYZ)
    for axis in lacking if table.has(XYZ) else ():
        for name in others:
            short = re.sub(r"[^a-z]", "", name.lower())
            words = re.split(r"[^a-z]+", name.lower())
            if axis in words or (len(short) <= 3 and axis in (short[:1], short[-1:])):
                value, allowed = f"missing (is it {name}?)", f"{axis}, m; or another name"
                raise InputError(table.where, f"column {axis}", value, allowed)


def _read_readings(table: Table) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the measurements (N, c) other than positions, and their standard deviations (N,).

    Both are by kind. Rows that `Session` would refuse are refused here, with their line number.
    """
    readings, sigmas = {}, {}
    joints = (KINDS[name] for name in table.header if re.fullmatch(r"read_q[1-9]\d*", name))
    for kind in (*_FURTHER, *joints):
        if not table.has(kind.cells):  # as of every kind that a text measures
            if kind.sigma and kind.sigma in table.cells:
                check_header(table.where, table.header, kind.cells)
            continue
        values = readings[kind.name] = table.block(kind.cells, kind.unit, True)
        blank = np.isnan(values)
        for row in np.flatnonzero(blank.any(axis=1) & ~blank.all(axis=1)):
            column = kind.cells[int(np.argmax(blank[row]))]
            allowed = f"a number; {', '.join(kind.cells)} all blank where none"
            raise table.error(row, column, allowed)
        if kind.label:
            for row in np.flatnonzero(table.blank(kind.label) & ~blank.any(axis=1)):
                field = f"line {table.lines[row]}, {kind.label}"
                raise InputError(table.where, field, "blank", f"a name beside {kind.cells[0]}")
        if kind.sigma in table.cells:
            unit = f"{kind.unit}, above 0"
            sigmas[kind.name] = table.numbers(kind.sigma, unit, True, lambda v: v > 0)
    return readings, sigmas


SIGMA = ("sigma_x", "sigma_y", "sigma_z")
_VARIANCE = ("cov_xx", "cov_yy", "cov_zz")
UNITS = {"t_s": "s", "temperature_c": "degrees Celsius", "payload_kg": "kg"}
LABELS = ("role", "group", "marker", "anchor", "sensor", "touch", "plane", "point")
_INDEX = ("index", "approach", "repeat_id")
_COVARIANCE = (*_VARIANCE, "cov_xy", "cov_xz", "cov_yz")


def read_csv(
    path: str | Path, arm: Arm, touch_distances: tuple[KnownDistance, ...] = ()
) -> Session:
    """Read a session from a CSV file. Its time is counted from `t_s` of the first row.

    Args:
        touch_distances: known distances between the points that the session touches.

    Raises:
        InputError: a column is missing or not known, or a cell is wrong; it names file, line and
            column.
    """
    table = read_table(path)
    joints = joint_names(arm.n)
    per_joint = (f"{word}_{q}" for word in ("approach", "run_up", "read") for q in joints)
    other = (*READ, *_INDEX, *UNITS, *SIGMA, *_COVARIANCE, *LABELS)
    known = (*joints, *XYZ, *other, *per_joint)
    check_header(table.where, table.header, joints)
    _check_measured(table, known)
    for name in table.header:
        if re.fullmatch(r"[qQ]_?\d+", name) and name not in joints:
            allowed = f"q1..q{arm.n} of arm {arm.name}"
            raise InputError(table.where, f"column {name}", "unknown", allowed)
    names = [name for name in table.header if not INCLINATION.match(name)]
    check_unknown(table.where, names, known)
    columns, labels = read_further_columns(table, set(known))
    readings, sigmas = _read_readings(table)
    blank = np.full((len(table), 1), np.nan)
    xyz = [table.lengths([k], blanks=True) if k in table.cells else blank for k in XYZ]
    q = table.lengths(joints, "rad or m")
    sides = read_approach(table, arm.n)
    sigma = None
    if table.has(SIGMA):
        sigma = table.block(SIGMA, "m, above 0", True, lambda v: v > 0)
    elif table.has(_VARIANCE):
        sigma = np.sqrt(table.block(_VARIANCE, "m^2, above 0", True, lambda v: v > 0))
    return Session.record(
        q=q,
        xyz=np.hstack(xyz),
        index=table.integers("index") if "index" in table.cells else None,
        approach=sides,
        run_up=_read_run_up(table, q, sides),
        repeat_id=table.integers("repeat_id", -1) if "repeat_id" in table.cells else None,
        sigma=sigma,
        columns=columns,
        labels=labels,
        source=table.where,
        readings=readings,
        sigmas=sigmas,
        touch_distances=touch_distances,
        begun_s=float(columns["t_s"][0]) if "t_s" in columns else 0.0,
    )


def write_csv(session: Session, path: str | Path) -> None:
    """Write a session; `read_session` gives the same one back."""
    joints = joint_names(session.n)
    columns: dict[str, Sequence[object] | np.ndarray] = {"index": session.index}
    columns.update({name: session.columns[name] for name in UNITS if name in session.columns})
    columns.update(make_approach_columns(session.sides))
    if not np.isnan(session.run_up).all():
        columns.update({f"run_up_{name}": session.run_up[:, j] for j, name in enumerate(joints)})
    columns.update({name: session.q[:, j] for j, name in enumerate(joints)})
    columns.update({name: session.xyz[:, j] for j, name in enumerate(XYZ)})
    for kind in (*_FURTHER, *(KINDS[f"read_q{k + 1}"] for k in session.read_joints)):
        if kind.name in session.readings:
            columns.update(zip(kind.cells, session.readings[kind.name].T, strict=True))
        if kind.name in session.sigmas:
            columns[kind.sigma] = session.sigmas[kind.name]
    columns["repeat_id"] = [None if r < 0 else r for r in session.repeat_id]
    if session.sigma is not None:
        columns.update({name: session.sigma[:, j] for j, name in enumerate(SIGMA)})
    columns.update({k: v for k, v in session.columns.items() if k not in columns})
    columns.update(session.labels)
    write_touches(session.touch_distances, Path(path).parent)
    write_table(path, list(columns), zip(*columns.values(), strict=True))


def joint_names(n: int) -> tuple[str, ...]:
    """Return ``q1..qn``."""
    return tuple(f"q{j}" for j in range(1, n + 1))


def read_further_columns(
    table: Table, known: set[str]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return circumstances and unknown columns by name: numbers (N,) and texts (N,).

    A column that is blank in every row is left out.
    """
    columns: dict[str, np.ndarray] = {}
    labels: dict[str, np.ndarray] = {}
    for name in table.header:
        if table.blank(name).all():
            continue
        if name in UNITS:
            columns[name] = _read_circumstance(table, name)
        elif name in LABELS or (name not in known and not table.is_numeric(name)):
            labels[name] = np.array(table.cells[name])
        elif name not in known or name in ("cov_xy", "cov_xz", "cov_yz"):
            blanks = INCLINATION.match(name) is not None
            columns[name] = table.numbers(name, "in every row, or text", blanks)
    return columns, labels


def _read_circumstance(table: Table, name: str) -> np.ndarray:
    lower, upper = range_of(name)
    unit = UNITS[name] + (f" of {lower:g} to {upper:g}" if math.isfinite(upper) else "")
    unit += ", in every row or in none"
    return table.numbers(name, unit, False, lambda v: lower <= v <= upper)


def approach_names(n: int) -> tuple[str, ...]:
    """Return ``approach_q1..qn``."""
    return tuple(f"approach_{name}" for name in joint_names(n))


def read_approach(table: Table, n: int) -> np.ndarray:
    """Return sides of arrival: (N,) if all joints share a column, else (N, n); 0 if unknown.

    Raises InputError for both kinds of columns, or for another value than -1, 0 and 1.
    """

    def is_side(value: float) -> bool:
        return value in (-1.0, 0.0, 1.0)

    per_joint = approach_names(n)
    if "approach" in table.cells:
        common = table.numbers("approach", "+1 from below, -1 from above", True, is_side)
        if not table.has(per_joint):
            return np.nan_to_num(common)
        raise InputError(table.where, "column approach", "beside approach_q1", "one of the two")
    if not table.has(per_joint):
        return np.zeros(len(table))
    return table.block(per_joint, "+1 from below, -1 from above, 0 unknown", False, is_side)


def _read_run_up(table: Table, q: np.ndarray, sides: np.ndarray) -> np.ndarray | None:
    """Return the joint values (N, n) at which the last approaches began; None without columns.

    Raises:
        InputError: an approach began on the other side than the side of arrival says.
    """
    names = [f"run_up_{name}" for name in joint_names(q.shape[1])]
    if not table.has(names):
        return None
    begun = table.block(names, "rad or m", True)
    for row, joint, allowed in list_wrong_run_ups(q, sides, begun):
        raise table.error(row, names[joint], allowed)
    return begun


def make_approach_columns(sides: np.ndarray) -> dict[str, Sequence[object] | np.ndarray]:
    """Return the columns of sides (N, n) that `read_approach` reads: one if all joints agree."""
    if (sides == sides[:, :1]).all():
        return {"approach": [None if side == 0 else int(side) for side in sides[:, 0]]}
    return dict(zip(approach_names(sides.shape[1]), sides.T, strict=True))


# ------------------------------------------------------------------ touched points

TOUCHES = "touches.yaml"
"""File of the known distances between touched points, in a bag's folder or beside a session."""


def read_touches(session: Path) -> tuple[KnownDistance, ...]:
    """Return the known distances in the file of a bag's folder or beside a session; else ()."""
    for folder in (session, session.parent):
        path = folder / TOUCHES
        if path.is_file():
            declared = parse_declared(Touches, read_yaml(path), str(path))
            return known_distances(declared.touch_distances)
    return ()


def merge_distances(
    known: Sequence[KnownDistance], more: Sequence[KnownDistance], where: str
) -> tuple[KnownDistance, ...]:
    """Return all distances of both, each once.

    Raises:
        InputError: both state a distance of the same two points, and not the same one.
    """
    both = {frozenset(distance[:2]): distance for distance in known}
    for distance in more:
        old = both.setdefault(frozenset(distance[:2]), distance)
        if old[2:] != distance[2:]:
            one, other, length, sigma = old
            allowed = f"{length:g} m, +-{1e3 * sigma:g} mm, as it is written already"
            raise InputError(where, f"distance {one} {other}", distance[2:], allowed)
    return tuple(both.values())


def write_touches(distances: tuple[KnownDistance, ...], folder: Path) -> None:
    """Write the file of known distances, if there are any.

    Raises:
        InputError: the folder has a file with a distance that is not among them.
    """
    path = folder / TOUCHES
    if not distances:
        return
    if path.is_file() and not set(read_touches(path)) <= set(distances):
        raise InputError(str(path), "touch_distances", "other ones", "another folder")
    known = {"touch_distances": [list(d) for d in distances]}
    write_text(path, yaml.safe_dump(known, sort_keys=False))
