"""What measures moves slowly during the session."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.core.effects.effect import Arm, Bias, Context, Instrument, Vec, parameter


@dataclass(frozen=True)
class CameraDrift(Bias):
    """Seen points drift linearly in time."""

    name = "camera_drift"
    title = "drift of the measurements"
    action = "Fix the mount of what measures and let it warm up; measure again in random order."
    instruments: ClassVar[Mapping[Instrument, str]] = {
        "camera": "Fix the cameras' mount and let them warm up; measure again in random order.",
        "tracker": "Let the tracker warm up; check its stand; measure its home point again.",
        "total_station": "Check tripod and level; sight a fixed prism first and last.",
    }
    needs = ("t_s",)

    x: float = parameter("m/h", "drift of the seen points", prior=2e-3)
    y: float = parameter("m/h", "drift of the seen points", prior=2e-3)
    z: float = parameter("m/h", "drift of the seen points", prior=2e-3)

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        hours = context.column("t_s", 0.0) / 3600.0
        return (point[0] + self.x * hours, point[1] + self.y * hours, point[2] + self.z * hours)
