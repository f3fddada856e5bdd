"""Joint limits for a first session: a part of each turning joint's range, about a home pose."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from longarm_comp.arm_folder.head import head_for
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.effects.joint_term import reach
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model


def narrowed(
    data: Mapping[str, Any], range_deg: float, home_deg: Mapping[str, float]
) -> tuple[dict[str, Any], dict[int, str]]:
    """What arm.yaml holds with narrower limits, and by row what they were.

    Args:
        range_deg: largest range of a turning joint; 0 leaves them as they are.
        home_deg: middle of the new range by joint name; default: of the old range.
    """
    names = [str(row.get("name") or f"joint{row['id']}") for row in data["joints"]]
    for name in home_deg:
        if name not in names:
            raise InputError("init", "--home", name, ", ".join(names))
    rows, notes = [], {}
    for name, row in zip(names, data["joints"], strict=True):
        limits = row.get("limits_deg")
        if limits is None:
            rows.append(row)
            continue
        low, high = map(float, limits)
        home = home_deg.get(name, (low + high) / 2)
        if not low <= home <= high:
            raise InputError("init", f"--home {name}", home, f"{low:g} to {high:g} deg")
        if not range_deg or high - low <= range_deg:
            rows.append(row)
            continue
        start = min(max(home - range_deg / 2, low), high - range_deg)
        made = [round(start, 6) + 0.0, round(start + range_deg, 6) + 0.0]
        rows.append({**row, "limits_deg": made})
        notes[row["id"]] = f"whole range {low:g} to {high:g} deg"
    return {**data, "joints": rows}, notes


def in_sight(data: Mapping[str, Any], home_deg: Mapping[str, float]) -> float:
    """Largest range of turning joints, deg, that two webcams see from the arm's own table.

    They stand within one and a half times the arm's reach then, and the marker is small.
    """
    for range_deg in (45.0, 40.0, 35.0, 30.0, 25.0, 20.0, 15.0):
        arm = Arm.parse(narrowed(data, range_deg, home_deg)[0], "arm.yaml")
        tip = declared_model(arm, deflection=False).tip(arm.mid)
        if np.linalg.norm(tip - head_for(arm).position_m) <= 1.5 * reach(arm):
            break
    return range_deg
