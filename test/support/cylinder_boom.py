"""The small arm with a hydraulic cylinder between two pins."""

from typing import Any

from small_arm import ARM

from longarm_comp.core.arm.arm import Arm

NEAR, FAR, ANGLE = 0.12, 0.30, 40.0


def boom(**change: Any) -> Arm:
    data = ARM.model_dump(mode="json", exclude_defaults=True)
    cylinder = {"near_m": NEAR, "far_m": FAR, "angle_deg": ANGLE, **change}
    data["joints"][1] |= {"drive": "hydraulic", "cylinder": cylinder, "name": "luff"}
    return Arm.parse(data, "boom.yaml")
