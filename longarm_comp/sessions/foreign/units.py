"""Units that columns of other programs are in, and a column's name without its unit."""

from __future__ import annotations

import re
from dataclasses import dataclass

LENGTH, ANGLE, TIME, TEMPERATURE, MASS = "length", "angle", "time", "temperature", "mass"


@dataclass(frozen=True)
class Unit:
    """A unit: ``SI value = factor * value + offset`` (degrees Celsius for temperatures)."""

    name: str
    kind: str
    factor: float
    offset: float = 0.0


_DEGREE = 0.017453292519943295
UNITS = {
    unit.name: unit
    for unit in (
        Unit("m", LENGTH, 1.0),
        Unit("cm", LENGTH, 1e-2),
        Unit("mm", LENGTH, 1e-3),
        Unit("um", LENGTH, 1e-6),
        Unit("in", LENGTH, 0.0254),
        Unit("rad", ANGLE, 1.0),
        Unit("mrad", ANGLE, 1e-3),
        Unit("deg", ANGLE, _DEGREE),
        Unit("arcmin", ANGLE, _DEGREE / 60),
        Unit("arcsec", ANGLE, _DEGREE / 3600),
        Unit("s", TIME, 1.0),
        Unit("ms", TIME, 1e-3),
        Unit("us", TIME, 1e-6),
        Unit("ns", TIME, 1e-9),
        Unit("min", TIME, 60.0),
        Unit("c", TEMPERATURE, 1.0),
        Unit("k", TEMPERATURE, 1.0, -273.15),
        Unit("f", TEMPERATURE, 1 / 1.8, -32 / 1.8),
        Unit("kg", MASS, 1.0),
        Unit("g", MASS, 1e-3),
        Unit("lb", MASS, 0.45359237),
    )
}
_ALSO = {
    "°": "deg",
    "degree": "deg",
    "degrees": "deg",
    "radian": "rad",
    "radians": "rad",
    "inch": "in",
    "inches": "in",
    "metre": "m",
    "meter": "m",
    "µm": "um",
    "μm": "um",
    "sec": "s",
    "seconds": "s",
    "µs": "us",
    "msec": "ms",
    "°c": "c",
    "degc": "c",
    "celsius": "c",
    "kelvin": "k",
    "°f": "f",
    "degf": "f",
}

_BRACKETED = re.compile(r"^(.*?)\s*[\[({<]\s*([^\])}>]*)\s*[\])}>]\s*$")
_SUFFIXED = re.compile(r"^(.*\S)\s*(?:[_/,]|\s)\s*([^\s_/,]+)$")


def unit_of(text: str) -> Unit | None:
    """The unit that a text names, or None."""
    plain = text.strip().strip("[](){}<>").strip().lower()
    return UNITS.get(_ALSO.get(plain, plain))


def split_name(name: str) -> tuple[str, Unit | None]:
    """A column's name and its unit: ``q1 [deg]``, ``x_mm``, ``Time (ms)``, ``A1/deg``."""
    for pattern in (_BRACKETED, _SUFFIXED):
        found = pattern.match(name)
        unit = unit_of(found.group(2)) if found else None
        if found and unit is not None:
            return found.group(1).strip(" ,/_"), unit
    return name.strip(), None
