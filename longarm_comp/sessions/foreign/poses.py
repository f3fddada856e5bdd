"""Finds the columns of a table that are one marker's pose: `FORMS` is the list of their names."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

from longarm_comp.sessions.foreign.units import MATRIX, ROTATION_VECTOR, Unit, split_name

POSITION = "position"
_APART, _BEGIN = r"[\s_.:,/\-\[(]*", r"(?:^|(?<=[\s_.:,/\-]))"


@dataclass(frozen=True)
class Form:
    """Names of the columns of a position or an orientation: one of `words`, then a part's name.

    A word of one letter stands close before the part (``tx``, ``q_w``), so that a marker ``R`` with
    ``R x`` is one.
    """

    convention: str
    """`POSITION`; for an orientation how `Rotation` reads `parts`, or empty: names do not say."""
    words: tuple[str, ...]
    parts: tuple[str, ...]

    @cached_property
    def _name_pattern(self) -> re.Pattern[str]:
        """Heading, word and part of a name."""
        digits = self.parts[0].isdigit()
        near = _APART if digits else "_?"
        words = [w.replace(" ", _APART) + ("", near, _APART)[min(len(w), 2)] for w in self.words]
        word = f"{_BEGIN}(?:{'|'.join(words)})"
        if self.parts == ("x", "y", "z") and "" in self.words:  # M1x is a name of markers
            word = f"(?:{word}|{_APART})"
        parts = "|".join(_APART.join(part) if digits else part for part in self.parts)
        return re.compile(f"(?i)(?P<heading>.*?)(?P<word>{word})(?P<part>{parts})[\\])]?")

    def read(self, name: str) -> tuple[str, str, int] | None:
        """Return heading, word and number of the part that a name without unit means, or None."""
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
"""From the fullest form on. Words of headings (tip, tcp, M1, a body's name) are no part of it."""


@dataclass(frozen=True)
class Found:
    """Columns that have one form: their places, in the order of its parts."""

    form: Form
    heading: str
    word: str
    places: tuple[int, ...]

    @property
    def turn(self) -> bool:
        return self.form.convention != POSITION


def find_forms(names: Sequence[str], apart: Collection[int] = ()) -> list[Found]:
    """Find all that a table holds in full, orientations before positions; no column is in two.

    Args:
        names: of the columns, with their units.
        apart: places of columns that are something else.
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
    """Return the unit that a part's name states: ``q_k`` is in no kelvin, ``tool C`` no Celsius."""
    return None if any(form.read(name) for form in FORMS) else split_name(name)[1]


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
    """Tell whether three turns about x, y, z are an orientation: only beside a position."""
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
    """Find the orientations of the marker whose position is in columns of these places: under its
    heading, under none, or under one that has no position."""
    own = {each.heading for each in found if not each.turn and set(read) & set(each.places)}
    others = set(headings(found)) - own
    return [
        each for each in found if each.turn and (not each.heading or each.heading not in others)
    ]


def headings(found: Iterable[Found]) -> dict[str, Found]:
    """Return the position of each marker by heading; the first where a heading has several."""
    made: dict[str, Found] = {}
    for each in found:
        if not each.turn:
            made.setdefault(each.heading, each)
    return made
