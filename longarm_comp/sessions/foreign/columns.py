"""Finds the session column that each column of another program's table stands for."""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.csv import UNITS, XYZ
from longarm_comp.sessions.foreign.cells import Cells
from longarm_comp.sessions.foreign.poses import axis_of
from longarm_comp.sessions.foreign.units import (
    ANGLE,
    LENGTH,
    MASS,
    TEMPERATURE,
    TIME,
    Unit,
    seconds,
    split_name,
)
from longarm_comp.sessions.foreign.units import UNITS as KNOWN
from longarm_comp.sessions.table import plain_name
from longarm_comp.sessions.targets import QUATERNION

JOINT = "joint"
_JOINT = re.compile(r"(?:q|j|joint|axis|a|theta)0*(\d{1,3})")
_TIP = re.compile(r"(?:tip|tcp|meas|measured|measurement|marker)(?=.)")
_EXACT = re.compile(
    r"index|repeat_id|approach(_q\d+)?|(run_up|read)_q\d+|sigma_([xyz]|rot)|cov_[xyz]{2}|distance|anchor|touch|plane"
    r"|ray_[xyz]|sensor|incl_\w+_[xy]|t_s|temperature_c|payload_kg|role|group|marker"
)
_WORDS = {
    **dict.fromkeys(("t", "time", "timestamp", "datetime", "clock"), "t_s"),
    **dict.fromkeys(("pointid", "pointno", "pointnr", "pointnumber"), "point"),
    **dict.fromkeys(("point", "pt", "no", "nr"), "point"),  # the user's own number or name of a row
    **dict.fromkeys(("temp", "temperature"), "temperature_c"),
    "payload": "payload_kg",
    "row": "index",
}
_TURNED = re.compile(
    r"(?:q(?:uat(?:ernion)?)?_?[wxyz0]|quat.*|roll|pitch|yaw|r[xyz]|[abc]|o[xyz]|euler.*|rot.*)"
)


@dataclass(frozen=True)
class Column:
    """A column of the session, and where it comes from.

    Attributes:
        name: its name in the session.
        source, place: name and index of the file's column.
        unit: unit of the file's column; None if it has none.
    """

    name: str
    source: str
    place: int
    unit: Unit | None


def kind_of(name: str, arm: Arm | None = None) -> str:
    """Return the kind of unit of a session's column; "" if it has none.

    It is `JOINT` for a joint of which it is not known whether it is revolute or prismatic.
    """
    joint = re.fullmatch(r"(?:run_up_|read_)?q(\d+)", name)
    if joint:
        number = int(joint.group(1))
        if arm is None or not 1 <= number <= arm.n:
            return JOINT
        row = arm.joints[arm.commanded[number - 1] - 1]
        return LENGTH if row.type == "prismatic" else ANGLE
    if name in XYZ or name == "distance" or re.fullmatch(r"sigma_[xyz]|cov_[xyz]{2}", name):
        return LENGTH
    if name == "sigma_rot" or name.startswith("incl_"):
        return ANGLE
    ends = {"t_s": TIME, "temperature_c": TEMPERATURE, "payload_kg": MASS}
    return ends.get(name, "")


def find_meaning(name: str, arm: Arm | None = None, *, headings: bool = True) -> str | None:
    """Return the session's column that a name without its unit means, or None.

    Args:
        headings: whether a heading over several columns may stand before the name.
    """
    if _EXACT.fullmatch(name):
        return name
    if arm is not None and name in arm.joint_names:
        return f"q{arm.joint_names.index(name) + 1}"
    plain = plain_name(name)
    if joint := _JOINT.fullmatch(plain):
        return f"q{int(joint.group(1))}"
    if axis := axis_of(_TIP.sub("", plain, count=1)):
        return axis
    spelt = [plain_name(own) for own in arm.joint_names] if arm else []
    for given in (plain, f"{plain}joint"):
        if spelt.count(given) == 1:
            return f"q{spelt.index(given) + 1}"
    if plain in _WORDS:
        return _WORDS[plain]
    heading, _, last = name.rpartition(" ")  # a heading over several columns, and the name below
    return find_meaning(last, arm) if heading and headings else None


def looks_like_orientation(name: str) -> bool:
    """Tell whether a name looks like a part of an orientation."""
    return _TURNED.fullmatch(re.sub(r"\s", "_", split_name(name)[0].lower())) is not None


def find_columns(
    cells: Cells,
    given: Mapping[str, str],
    defaults: Mapping[str, Unit],
    arm: Arm | None,
    apart: Collection[str] = (),
    axes: Mapping[int, str] | None = None,
) -> list[Column]:
    """Find the columns of the session that a file holds.

    Args:
        given: session column by name in the file, perhaps with its unit: ``{"A": "q3:mm"}``. The
            name may be without the unit that it has in the file.
        defaults: unit of columns that state none, by kind.
        arm: tells names and types of the joints; None: joints without a unit are revolute.
        apart: names of columns to leave out, because they are read as an orientation.
        axes: ``x``, ``y`` or ``z`` by index of a column that was recognised as a coordinate.

    Raises:
        InputError: a mapped name, unit or column is not allowed, a unit is missing, or two columns
            have one meaning.
    """
    where = cells.where
    mapped = {cells.place(key, "--map"): key for key in given}
    ranked: list[tuple[int, Column]] = []
    for place, source in enumerate(cells.names):
        stem, unit = split_name(source)
        if place in mapped:
            rank, key = 0, mapped[place]
            name, _, own = given[key].partition(":")
            if own and own not in KNOWN:
                raise InputError(where, f"--map {key}", own, f"a unit: {', '.join(KNOWN)}")
            unit = KNOWN[own] if own else unit
            if not re.fullmatch(r"[A-Za-z_]\w*", name):
                allowed = "a column of a session: q1..qn, x, y, z, ..."
                raise InputError(where, f"--map {key}", name, allowed)
        elif stem and source not in apart:
            rank = 1 + (find_meaning(stem, arm, headings=False) is None)
            meant = find_meaning(source, arm) or find_meaning(stem, arm)
            name = meant or (axes or {}).get(place, "")
        else:
            continue
        if name:
            ranked.append((rank, Column(name, source, place, unit)))
    found: dict[str, tuple[int, Column]] = {}
    # What the user says wins; a name by itself wins over one with a heading before it.
    for rank, column in sorted(ranked, key=lambda each: each[0]):
        best, first = found.setdefault(column.name, (rank, column))
        if column is not first and rank == best:
            both, one = f"{first.source} and {column.source}", f"--map NAME={column.name}"
            raise InputError(where, f"column {column.name}", both, f"one; choose it with {one}")
    made = [replace(c, unit=_choose_unit(cells, c, defaults, arm)) for _, c in found.values()]
    return sorted(made, key=lambda c: _sort_key(c.name))


def _choose_unit(
    cells: Cells, column: Column, defaults: Mapping[str, Unit], arm: Arm | None
) -> Unit | None:
    """Return the unit of a column; None if it needs none, such as a text or a time of day."""
    name, source, unit = column.name, column.source, column.unit
    kind = kind_of(name, arm)
    if not kind or (name == "t_s" and seconds(cells.column(column.place)) is not None):
        return None
    kinds = (ANGLE, LENGTH) if kind == JOINT else (kind,)
    if unit is None and name in UNITS and source == name:
        unit = {TIME: KNOWN["s"], TEMPERATURE: KNOWN["c"], MASS: KNOWN["kg"]}[kind]
    unit = unit or defaults.get(kinds[0])
    choice = ", ".join(u.name for u in KNOWN.values() if u.kind in kinds)
    if unit is None:
        allowed = f"a unit: --units, or --map '{source}={name}:UNIT' with one of {choice}"
        raise InputError(cells.where, f"column {source}", "no unit", allowed)
    if unit.kind not in kinds:
        raise InputError(cells.where, f"column {source}", unit.name, f"for {name}: {choice}")
    return unit


def _sort_key(name: str) -> tuple[int, int, str]:
    joint = re.fullmatch(r"q(\d+)", name)
    if joint:
        return 2, int(joint.group(1)), ""
    groups = (("index", *UNITS, "approach"), (), XYZ, QUATERNION)
    for k, group in enumerate(groups, 1):
        if name in group:
            return k, group.index(name), ""
    return 9, 0, name
