"""Values in the units that people read: degrees, millimetres, per cent."""

import math
import re
from collections.abc import Mapping

_PLACE = re.compile(r"\b(?:joint|row|frame) \d+\b")


def for_people(unit: str) -> tuple[float, str]:
    """Return the factor from an SI unit to the unit that people read, and this unit's name."""
    whole, slash, per = unit.partition("/")
    known = _READ if unit == whole else _PER
    factor, name = known.get(whole, (1.0, whole))
    return factor, f"{name}{slash}{per}"


_PER = {"rad": (math.degrees(1.0), "°"), "m": (1e3, "mm")}
_READ = {**_PER, "1": (100.0, "%")}


def describe_range(low: float, high: float) -> str:
    """Write the ends of a range, or its only value."""
    return " to ".join(dict.fromkeys((f"{low:.4g}", f"{high:.4g}")))


def in_names(text: str, called: Mapping[str, str]) -> str:
    """Replace joints, rows and frames in a text by their names (`Arm.names_for_people`)."""
    return _PLACE.sub(lambda found: called.get(found[0], found[0]), text)
