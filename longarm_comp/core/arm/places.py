"""Places of an arm that are rows of arm.yaml: what people call them, and which can hold links."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

_Rows: TypeAlias = Sequence[Any]
"""`Arm.joints`; arm.py reads this file."""


def called(joints: _Rows, commanded: Sequence[int]) -> dict[str, str]:
    """As `Arm.called`, of rows and the ids of those that are commanded."""
    made: dict[str, str] = {}
    numbers = {row: f"q{k}" for k, row in enumerate(commanded, 1)}
    for joint in joints:
        row, number = joint.id, numbers.get(joint.id)
        own = joint.name not in (None, f"joint{row}", f"joint_{row}", number)
        if own:
            made |= {f"{kind} {row}": f"{kind} {joint.name}" for kind in ("row", "frame")}
            made[f"joint {row}"] = f"{joint.name} ({number})" if number else str(joint.name)
        elif number and number != f"q{row}":
            made[f"joint {row}"] = f"joint {number}"
    return made


def link_places(joints: _Rows) -> list[tuple[int, str, float]]:
    """Where links can lie: row, role, length (m, at joint value 0), longest first."""
    held = [(j.id, role, size) for j in joints if j.type != "fixed"
            for role, size in (("a", j.a_m), ("d", j.d_m)) if size]  # fmt: skip
    return sorted(held, key=lambda place: -abs(place[2]))
