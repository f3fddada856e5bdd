"""An arm declared row by row: a modified DH table, tubes that bend, servo masses.

Each row is a set of answers by key: from a flag (``type=revolute a=0.1 limits=-30..30``), or
asked one after another.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from longarm_comp.core.errors import InputError

Ask = Callable[[str, str], str]
"""Shows a question and a default, and returns the answer."""

MATERIALS = {
    "aluminium": (69e9, 0.33, 2700.0),
    "steel": (205e9, 0.29, 7850.0),
    "carbon": (70e9, 0.30, 1550.0),
    "petg": (2.1e9, 0.38, 1270.0),
    "pla": (3.1e9, 0.36, 1240.0),
    "nylon": (1.7e9, 0.39, 1010.0),
}
"""Young's modulus (Pa), Poisson's ratio and density (kg/m^3): usual values, not this arm's."""

_TYPES = ("revolute", "prismatic", "fixed")
_RANGE = re.compile(r"(-?[\d.]+)\.\.(-?[\d.]+)")
_TUBE = re.compile(r"([\d.]+)(?:/([\d.]+))?")


@dataclass(frozen=True)
class _Question:
    """One answer of a row: its key, what is asked, what stands there if nothing is said."""

    key: str
    text: str
    default: str = ""
    asked: bool = True


_QUESTIONS = (
    _Question("type", "type (revolute, prismatic, fixed)", "revolute"),
    _Question("alpha", "alpha: angle from the last z to this z about the last x, deg", "0"),
    _Question("a", "a: distance from the last z to this z along the last x, m", "0"),
    _Question("d", "d: distance from the last x to this x along this z, m", "0"),
    _Question("theta", "theta: angle from the last x to this x about this z, deg", "0"),
    _Question("limits", "limits, deg or m, LOWER..UPPER", "-45..45"),
    _Question("tube_a", "tube along a: outer/inner diameter, mm; 0: rigid", "0"),
    _Question("tube_d", "tube along d: outer/inner diameter, mm; 0: rigid", "0"),
    _Question("material", f"material of the tubes ({', '.join(MATERIALS)})", "aluminium"),
    _Question("servo_kg", "mass of the servo that sits at this joint's frame, kg", "0"),
    _Question("name", "name", "", asked=False),
    _Question("mimic", "moves with another joint: NAME or NAME*FACTOR", "", asked=False),
)
_KEYS = {question.key: question for question in _QUESTIONS}


def ask_rows(ask: Ask, count: int) -> list[dict[str, str]]:
    """Rows of answers, asked one by one. What does not apply to a row is not asked."""
    rows = []
    for number in range(1, count + 1):
        row: dict[str, str] = {}
        for question in _QUESTIONS:
            if question.asked and _applies(question.key, row):
                row[question.key] = ask(f"joint {number}, {question.text}", question.default)
        rows.append(row)
    return rows


def row_of(flag: str) -> dict[str, str]:
    """Answers of one row from ``key=value key=value``."""
    row = {}
    for word in flag.split():
        key, equals, value = word.partition("=")
        if not equals or key not in _KEYS:
            raise InputError("init", "--joint", word, f"KEY=VALUE, keys {', '.join(_KEYS)}")
        row[key] = value
    return row


def arm_of(
    name: str, rows: Sequence[Mapping[str, str]], tip: Sequence[float], payload_kg: float
) -> dict[str, Any]:
    """What arm.yaml holds for rows of answers; `tip` (3,) m in the last frame."""
    if not rows:
        raise InputError("init", "--joint", "none", "at least one joint")
    joints, links, masses = [], [], []
    for number, given in enumerate(rows, 1):
        row = _Row(number, given)
        joints.append(row.joint())
        links += row.links()
        masses += row.masses()
    data: dict[str, Any] = {
        "name": name,
        "convention": "mdh_craig",
        "tip": {"frame": len(joints), "position_m": list(tip)},
    }
    if payload_kg:
        data["payload"] = {
            "mass_kg": payload_kg, "frame": len(joints), "position_m": list(tip)
        }  # fmt: skip
    return data | {"joints": joints, "links": links, "point_masses": masses}


def _applies(key: str, row: Mapping[str, str]) -> bool:
    if key == "limits":
        return row["type"] != "fixed"
    if key in ("tube_a", "tube_d"):
        length = row["a" if key == "tube_a" else "d"]
        return row["type"] != "fixed" and length.strip() not in ("", "0", "0.0")
    if key == "material":
        return any(row.get(tube, "0") != "0" for tube in ("tube_a", "tube_d"))
    return True


@dataclass(frozen=True)
class _Row:
    number: int
    given: Mapping[str, str]

    def text(self, key: str) -> str:
        return self.given.get(key, _KEYS[key].default).strip()

    def number_of(self, key: str) -> float:
        try:
            value = float(self.text(key))
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.error(key, "a number")
        return value

    def error(self, key: str, allowed: str) -> InputError:
        return InputError("init", f"joint {self.number}, {key}", self.text(key), allowed)

    def joint(self) -> dict[str, Any]:
        kind = self.text("type")
        if kind not in _TYPES:
            raise self.error("type", ", ".join(_TYPES))
        row: dict[str, Any] = {"id": self.number}
        if self.text("name"):
            row["name"] = self.text("name")
        row |= {
            "type": kind,
            "a_m": self.number_of("a"),
            "alpha_deg": self.number_of("alpha"),
            "d_m": self.number_of("d"),
            "theta_offset_deg": self.number_of("theta"),
        }
        if self.text("mimic"):
            leader, star, factor = self.text("mimic").partition("*")
            try:
                multiplier = float(factor) if star else 1.0
            except ValueError:
                raise self.error("mimic", "NAME or NAME*FACTOR") from None
            return {**row, "mimic": {"joint": leader, "multiplier": multiplier}}
        if kind != "fixed":
            row["limits_deg" if kind == "revolute" else "limits_m"] = self.limits()
        return row

    def limits(self) -> list[float]:
        found = _RANGE.fullmatch(self.text("limits"))
        try:
            low, high = (float(v) for v in found.groups()) if found else (1.0, 0.0)
        except ValueError:
            low, high = 1.0, 0.0
        if not low < high:
            raise self.error("limits", "LOWER..UPPER, LOWER below UPPER, for instance -30..30")
        return [low, high]

    def links(self) -> list[dict[str, Any]]:
        made = []
        for role in ("a", "d"):
            outer, inner = self.tube(f"tube_{role}")
            if outer:
                made.append(self.beam(role, outer, inner))
        return made

    def tube(self, key: str) -> tuple[float, float]:
        """Outer and inner diameter, m."""
        found = _TUBE.fullmatch(self.text(key))
        try:
            outer, inner = (float(v or 0) for v in found.groups()) if found else (0.0, 1.0)
        except ValueError:
            outer, inner = 0.0, 1.0
        if (outer and outer <= inner) or (not outer and inner):
            raise self.error(key, "OUTER/INNER or OUTER in mm, for instance 30/26; 0: rigid")
        return outer / 1e3, inner / 1e3

    def beam(self, role: str, outer: float, inner: float) -> dict[str, Any]:
        material = self.text("material")
        if material not in MATERIALS:
            raise self.error("material", ", ".join(MATERIALS))
        modulus, poisson, density = MATERIALS[material]
        length = abs(self.number_of(role))
        if not length:
            raise self.error(f"tube_{role}", f"0, because {role} is 0")
        slides = role == "d" and self.text("type") == "prismatic"
        mass = density * math.pi / 4 * (outer**2 - inner**2) * length
        return {
            "name": f"tube_{self.number}{role}",
            "row": self.number,
            "role": role,
            "length_m": "rest" if slides else length,
            "section": {"type": "tube", "od_m": round(outer, 6), "id_m": round(inner, 6)},
            "E_pa": modulus,
            "poisson": poisson,
            "mass_kg": round(mass, 4),
            "body_length_m": length,
        }

    def masses(self) -> list[dict[str, Any]]:
        mass = self.number_of("servo_kg")
        if not mass:
            return []
        return [{"name": f"servo{self.number}", "frame": self.number, "mass_kg": mass}]
