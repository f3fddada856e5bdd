"""Finds the columns of a table that hold a marker's pose, by the names in `FORMS`; reads turns."""

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from longarm_comp.core.errors import InputError
from longarm_comp.sessions.foreign.cells import Cells
from longarm_comp.sessions.foreign.units import (
    ANGLE,
    MATRIX,
    ROTATION_VECTOR,
    Rotation,
    Unit,
    split_name,
)

POSITION = "position"
_APART, _BEGIN = r"[\s_.:,/\-\[(]*", r"(?:^|(?<=[\s_.:,/\-]))"


@dataclass(frozen=True)
class Form:
    """Column names of a position or an orientation: one of `words`, then one of `parts`.

    Between a word of one letter and a lettered part, only ``_`` may stand (``tx``, ``q_w``). So
    ``R x`` is the coordinate x of a marker ``R``.
    """

    convention: str
    """`POSITION`, or the convention of `Rotation` for the parts; empty if names do not tell it."""
    words: tuple[str, ...]
    parts: tuple[str, ...]

    @cached_property
    def _name_pattern(self) -> re.Pattern[str]:
        """The pattern of a name, with groups for heading, word and part."""
        digits = self.parts[0].isdigit()
        near = _APART if digits else "_?"
        words = [w.replace(" ", _APART) + ("", near, _APART)[min(len(w), 2)] for w in self.words]
        word = f"{_BEGIN}(?:{'|'.join(words)})"
        if self.parts == ("x", "y", "z") and "" in self.words:  # M1x is a name of markers
            word = f"(?:{word}|{_APART})"
        parts = "|".join(_APART.join(part) if digits else part for part in self.parts)
        return re.compile(f"(?i)(?P<heading>.*?)(?P<word>{word})(?P<part>{parts})[\\])]?")

    def read(self, name: str) -> tuple[str, str, int] | None:
        """Split a name without unit into heading, word and index in `parts`.

        None if the name does not have this form.
        """
        found = self._name_pattern.fullmatch(name)
        if found is None:
            return None
        part = re.sub(_APART, "", found["part"].lower())
        word = re.sub(_APART, "", found["word"])
        return found["heading"].strip(" _.:,/-"), word, self.parts.index(part)


_QUATERNION = (
    *("q", "quat", "quaternion", "rot", "rotation", "orientation", "attitude", "ori", "o", "r"),
)
_TURN = ("r", "rot", "rotation", "o", "orientation", "angle", "ang", "euler", "euler angle")
_SQUARE = ("r", "m", "t", "h", "rot", "rotation", "mat", "matrix", "rotation matrix", "dcm")
_LINEAR = ("t", "p", "pos", "position", "trans", "translation", "loc", "location", "coord")
_ANGLES = ("", "euler", "rot", "rotation", "orientation", "angle")

FORMS = (
    Form(POSITION, ("", *_LINEAR), ("x", "y", "z")),
    Form(POSITION, ("t", "h"), ("03", "13", "23")),
    Form(POSITION, ("t", "h"), ("14", "24", "34")),
    Form(MATRIX, _SQUARE, ("00", "01", "02", "10", "11", "12", "20", "21", "22")),
    Form(MATRIX, _SQUARE, ("11", "12", "13", "21", "22", "23", "31", "32", "33")),
    Form(MATRIX, ("",), ("nx", "ox", "ax", "ny", "oy", "ay", "nz", "oz", "az")),
    Form("xyzw", _QUATERNION, ("x", "y", "z", "w")),
    Form("xyzw", _QUATERNION, ("x", "y", "z", "0")),
    Form("xyzw", _QUATERNION, ("i", "j", "k", "0")),
    Form("xyzw", _QUATERNION, ("i", "j", "k", "r")),
    Form("xyzw", _QUATERNION, ("i", "j", "k", "w")),
    Form("", ("q", "quat", "quaternion"), ("0", "1", "2", "3")),
    Form(
        ROTATION_VECTOR, ("rv", "rvec", "rotvec", "rotation vector", "axis angle"), ("x", "y", "z")
    ),
    Form("", _TURN, ("x", "y", "z")),
    Form("", _ANGLES, ("roll", "pitch", "yaw")),
    Form("", ("",), ("a", "b", "c")),
    Form("", ("",), ("w", "p", "r")),
)
"""The forms, the most complete first. A heading (tip, tcp, M1, a body) may stand before a name."""


@dataclass(frozen=True)
class Found:
    """The columns of a table that have one form.

    Attributes:
        heading: text before the word in every name, such as the name of a marker; may be empty.
        word: the word of the form in these names.
        places: indices of the columns, in the order of `Form.parts`.
    """

    form: Form
    heading: str
    word: str
    places: tuple[int, ...]

    @property
    def turn(self) -> bool:
        return self.form.convention != POSITION


def find_forms(names: Sequence[str], apart: Collection[int] = ()) -> list[Found]:
    """Find the positions and orientations of which a table has every column.

    Orientations are found first. No column belongs to two of them.

    Args:
        names: names of the columns, with their units.
        apart: indices of columns that are something else.
    """
    whole: list[Found] = []
    used = set(apart)
    for turn in (True, False):
        for form in FORMS:
            if turn == (form.convention == POSITION):
                continue
            for found in _find_all(form, names):
                if not used & set(found.places) and _is_meant(found, names):
                    whole.append(found)
                    used |= set(found.places)
    return whole


def unit_in(name: str) -> Unit | None:
    """Return the unit that a column's name states, or None.

    A name that is a part of a form has none: ``q_k`` is not in kelvin, ``tool C`` not in Celsius.
    """
    return None if any(form.read(name) for form in FORMS) else split_name(name)[1]


def read_rotation(cells: Cells, rotation: Rotation, defaults: Mapping[str, Unit]) -> np.ndarray:
    """Return the numbers (N, 3, 4 or 9) of an orientation, angles in rad.

    Args:
        defaults: unit of columns that state none, by kind.

    Raises:
        InputError: a cell holds no number, or the unit of an angle is not known.
    """
    parts = []
    for name in rotation.columns:
        numbers = cells.numbers(cells.names.index(name), True)
        if rotation.angles:
            unit = unit_in(name) or defaults.get(ANGLE)
            if rotation.convention and (unit is None or unit.kind != ANGLE):
                field = f"column {name}"
                raise InputError(cells.where, field, "no angle's unit", "--units deg or rad")
            numbers = numbers * (unit.factor if unit else math.nan)
        parts.append(numbers)
    return np.stack(parts, axis=-1)


def _find_all(form: Form, names: Sequence[str]) -> Iterable[Found]:
    groups: dict[tuple[str, str], dict[int, int]] = {}
    for place, name in enumerate(names):
        read = form.read(name)
        if read is None and (unit_in(name) is None or len(form.parts) == 3):  # others have no unit
            read = form.read(split_name(name)[0])
        if read is not None:
            heading, word, part = read
            groups.setdefault((heading, word), {}).setdefault(part, place)
    for (heading, word), places in groups.items():
        if len(places) == len(form.parts):
            yield Found(form, heading, word, tuple(places[k] for k in range(len(places))))


def _is_meant(found: Found, names: Sequence[str]) -> bool:
    """Tell whether columns are what their form says.

    Names such as ``Rx``, ``Ry``, ``Rz`` are ambiguous. They count as an orientation only if their
    heading also has a position.
    """
    if found.form.convention or found.form.parts != ("x", "y", "z"):
        return True
    positions = (p for form in FORMS if form.convention == POSITION for p in _find_all(form, names))
    return any(p.heading == found.heading and p.places != found.places for p in positions)


def axis_of(name: str) -> str | None:
    """Return the axis that a bare column name such as ``x`` or ``Tx`` stands for, or None."""
    for form in FORMS:
        read = form.read(name) if form.convention == POSITION else None
        if read is not None and not read[0]:
            return "xyz"[read[2]]
    return None


def find_orientations(found: Sequence[Found], read: Collection[int]) -> list[Found]:
    """Find the orientations of the marker whose position is in the columns `read` (indices).

    They are under its heading, under no heading, or under a heading without a position.
    """
    own = {each.heading for each in found if not each.turn and set(read) & set(each.places)}
    others = set(headings(found)) - own
    return [
        each for each in found if each.turn and (not each.heading or each.heading not in others)
    ]


def headings(found: Iterable[Found]) -> dict[str, Found]:
    """Return the position of each marker by its heading; the first if a heading has several."""
    made: dict[str, Found] = {}
    for each in found:
        if not each.turn:
            made.setdefault(each.heading, each)
    return made
