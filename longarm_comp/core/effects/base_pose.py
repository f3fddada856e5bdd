"""Where the base stands, seen by the camera or tracker."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from longarm_comp.core.arm.measuring import three
from longarm_comp.core.arm.posture import PLACEMENT, Posture, Twists
from longarm_comp.core.arm.spatial import Frame, Twist, exp_large
from longarm_comp.core.effects.effect import Arm, Effect, Parameter, Sites, parameter, place


@dataclass(frozen=True)
class BasePose(Effect):
    """Placement of the base beyond the declared one; one per `group` where the base was moved.

    It says where the tracker's frame lies, so gravity turns with it and keeps its declared
    direction in the arm's base; a base that leans against gravity is `gravity_direction`.
    The base may stand anywhere, unless arm.yaml gives a tolerance.
    """

    name = "base_pose"
    title = "base placement"
    action = "Fix the base so that it cannot shift; calibrate after every move of it."
    geometry = True
    seen_only = True

    group: str = place(default="")
    x: float = parameter("m", "base position error", prior=0.05, unknown=True)
    y: float = parameter("m", "base position error", prior=0.05, unknown=True)
    z: float = parameter("m", "base position error", prior=0.05, unknown=True)
    rx: float = parameter("rad", "base orientation error", prior=0.05, unknown=True)
    ry: float = parameter("rad", "base orientation error", prior=0.05, unknown=True)
    rz: float = parameter("rad", "base orientation error", prior=0.05, unknown=True)

    @property
    def where(self) -> str:
        return f"base of group {self.group}" if self.group else "base"

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        """One placement; groups are of a session."""
        return [{}]

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        known = arm.tolerance.base
        if known is None:
            return self.declared()
        turn = (math.radians(v) for v in three(known.rpy_deg))
        priors = (*three(known.xyz_m), *turn)
        pairs = zip(self.declared(), priors, strict=True)
        return tuple(dataclasses.replace(p, prior=prior, unknown=False) for p, prior in pairs)

    def base(self, arm: Arm) -> Frame:
        moved = exp_large((self.x, self.y, self.z, self.rx, self.ry, self.rz))
        return arm.base.frame() @ moved

    def twists(self, posture: Posture) -> Twists:
        twist: Twist = (self.x, self.y, self.z, self.rx, self.ry, self.rz)
        if self.group:
            mine = posture.context.is_label("group", self.group)
            twist = tuple(mine * t for t in twist)  # type: ignore[assignment]
        return {PLACEMENT: twist}
