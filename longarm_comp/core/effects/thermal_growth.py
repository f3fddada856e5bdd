"""Links that grow with temperature."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm.spatial import Twist, add_twists
from longarm_comp.core.effects.effect import Effect, Posture, Twists, parameter


@dataclass(frozen=True)
class ThermalGrowth(Effect):
    """All lengths grow by ``expansion (T - T_ref)``."""

    name = "thermal_growth"
    title = "thermal growth"
    action = "Keep the temperature steady, or measure it while the arm works."
    needs = ("temperature_c",)

    expansion: float = parameter("1/K", "expansion coefficient of the links", prior=1e-4)

    def twists(self, posture: Posture) -> Twists:
        """Translation along every row's a and d, in proportion to their length."""
        warm = posture.context.column("temperature_c", posture.arm.reference_temperature_c)
        rise = self.expansion * (warm - posture.arm.reference_temperature_c)
        growth: dict[int, Twist] = {}
        for joint, value in zip(posture.arm.joints, posture.values, strict=True):
            d = joint.d_m + value if joint.type == "prismatic" else joint.d_m
            before, here = posture.frame(joint.id - 1), posture.frame(joint.id)
            growth[here] = (0.0, 0.0, rise * d, 0.0, 0.0, 0.0)
            along_x: Twist = (rise * joint.a_m, 0.0, 0.0, 0.0, 0.0, 0.0)
            growth[before] = add_twists(growth[before], along_x) if before in growth else along_x
        return growth
