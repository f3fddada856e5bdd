"""Makes the content of arm.yaml from texts, one for each row of the modified DH table.

A text has keys and values, also of bending tubes and servo masses: ``a=0.1 limits=-30..30``.
"""

import math
import re
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator

from longarm_comp.core.errors import InputError
from longarm_comp.core.yaml_file import Closed, parse_declared

MATERIALS = {
    "aluminium": (69e9, 0.33, 2700.0),
    "steel": (205e9, 0.29, 7850.0),
    "carbon": (70e9, 0.30, 1550.0),
    "petg": (2.1e9, 0.38, 1270.0),
    "pla": (3.1e9, 0.36, 1240.0),
    "nylon": (1.7e9, 0.39, 1010.0),
}
"""Young's modulus (Pa), Poisson's ratio and density (kg/m^3): usual values of the material."""


_NUMBER = r"(\d+\.?\d*|\.\d+)"


def _parse_limits(text: Any) -> tuple[float, float]:
    found = re.fullmatch(rf"(-?){_NUMBER}\.\.(-?){_NUMBER}", str(text))
    signs = found.groups() if found else ("", "1", "", "0")
    low, high = float("".join(signs[:2])), float("".join(signs[2:]))
    if not low < high:
        raise ValueError("LOWER..UPPER with LOWER below UPPER, for instance -30..30")
    return low, high


def _parse_tube(text: Any) -> tuple[float, float]:
    """Return outer and inner diameter, m."""
    found = re.fullmatch(rf"{_NUMBER}(?:/{_NUMBER})?", str(text))
    outer, inner = (float(v or 0) for v in found.groups()) if found else (0.0, 1.0)
    if (outer and outer <= inner) or (not outer and inner):
        raise ValueError("OUTER/INNER or OUTER in mm, for instance 30/26; 0: rigid")
    return outer / 1e3, inner / 1e3


def _parse_mimic(text: Any) -> tuple[str, float] | None:
    leader, star, factor = str(text or "").partition("*")
    try:
        return (leader, float(factor) if star else 1.0) if leader else None
    except ValueError:
        raise ValueError("NAME or NAME*FACTOR") from None


Limits = Annotated[tuple[float, float], BeforeValidator(_parse_limits)]
Tube = Annotated[tuple[float, float], BeforeValidator(_parse_tube)]
Mimic = Annotated[tuple[str, float] | None, BeforeValidator(_parse_mimic)]


class _Row(Closed):
    """A row of the modified DH table, in degrees and m.

    Attributes:
        limits: lower and upper limit of the joint, degrees or m.
        tube_a, tube_d: outer and inner diameter (m) of a tube along a or d; 0: rigid.
        servo_kg: mass of the servo at this joint's frame.
        mimic: the joint that this one follows, and the factor.
    """

    type: Literal["revolute", "prismatic", "fixed"] = "revolute"
    alpha: float = 0.0
    a: float = 0.0
    d: float = 0.0
    theta: float = 0.0
    limits: Limits = (-45.0, 45.0)
    tube_a: Tube = (0.0, 0.0)
    tube_d: Tube = (0.0, 0.0)
    material: str = "aluminium"
    servo_kg: float = 0.0
    name: str = ""
    mimic: Mimic = None

    def joint(self, number: int) -> dict[str, Any]:
        """Return the row's entry in `joints` of arm.yaml."""
        row: dict[str, Any] = {"id": number, **({"name": self.name} if self.name else {})}
        row |= {
            "type": self.type,
            "a_m": self.a,
            "alpha_deg": self.alpha,
            "d_m": self.d,
            "theta_offset_deg": self.theta,
        }
        if self.mimic:
            return {**row, "mimic": {"joint": self.mimic[0], "multiplier": self.mimic[1]}}
        if self.type != "fixed":
            row["limits_deg" if self.type == "revolute" else "limits_m"] = list(self.limits)
        return row

    def beam(self, number: int, role: str) -> list[dict[str, Any]]:
        """Return a list with the entry in `links` for the tube along a or d; empty if none."""
        (outer, inner), length = getattr(self, f"tube_{role}"), abs(getattr(self, role))
        if not outer:
            return []
        if self.material not in MATERIALS:
            raise InputError(_name_joint(number), "material", self.material, ", ".join(MATERIALS))
        if not length:
            allowed = f"0, because {role} is 0"
            raise InputError(_name_joint(number), f"tube_{role}", 1e3 * outer, allowed)
        modulus, poisson, density = MATERIALS[self.material]
        slides = role == "d" and self.type == "prismatic"
        mass = density * math.pi / 4 * (outer**2 - inner**2) * length
        entry = {
            "name": f"tube_{number}{role}",
            "row": number,
            "role": role,
            "length_m": "rest" if slides else length,
            "section": {"type": "tube", "od_m": round(outer, 6), "id_m": round(inner, 6)},
            "E_pa": modulus,
            "poisson": poisson,
            "mass_kg": round(mass, 4),
            "body_length_m": length,
        }
        return [entry]


def _name_joint(number: int) -> str:
    return f"init: joint {number}"


def arm_of(
    name: str, given: Sequence[str], tip: Sequence[float], payload_kg: float
) -> dict[str, Any]:
    """Return the content of arm.yaml.

    Args:
        given: texts of the rows, base to tip; at least one.
        tip: (3,) tip in the last frame, m.

    Raises:
        InputError: a text is no list of KEY=VALUE, or a key or value is not allowed.
    """
    rows = []
    for number, flag in enumerate(given, 1):
        row = {}
        for word in flag.split():
            key, equals, value = word.partition("=")
            if not equals:
                raise InputError("init", "--joint", word, "KEY=VALUE")
            row[key] = value
        rows.append((number, parse_declared(_Row, row, _name_joint(number))))
    data: dict[str, Any] = {
        "name": name,
        "convention": "mdh_craig",
        "tip": {"frame": len(rows), "position_m": list(tip)},
    }
    if payload_kg:
        data["payload"] = {"mass_kg": payload_kg, "frame": len(rows), "position_m": list(tip)}
    return data | {
        "joints": [row.joint(k) for k, row in rows],
        "links": [beam for k, row in rows for role in "ad" for beam in row.beam(k, role)],
        "point_masses": [
            {"name": f"servo{k}", "frame": k, "mass_kg": row.servo_kg}
            for k, row in rows
            if row.servo_kg
        ],
    }
