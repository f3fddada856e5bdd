"""One DH row of the declared arm: its geometry, limits, drive and couplings."""

import math
from typing import Literal

from pydantic import Field

from longarm_comp.core.arm.parts import Coupling, Cylinder, Mimic, Pose, Positive, Tolerance
from longarm_comp.core.yaml_file import Declared, Misdeclared


class Joint(Declared):
    """A row of the chain (modified DH, Craig)."""

    id: int = Field(ge=1)
    name: str | None = None
    type: Literal["revolute", "prismatic", "fixed"]
    a_m: float = 0.0
    alpha_deg: float = 0.0
    d_m: float = 0.0
    theta_offset_deg: float = 0.0
    limits_deg: tuple[float, float] | None = None
    limits_m: tuple[float, float] | None = None
    endless: bool = Field(
        default=False,
        description="a revolute joint that turns on and on: poses are planned within limits_deg, "
        "+-180 by default, and paths may leave them",
    )
    step_deg: Positive | None = Field(
        default=None, description="the servo's step, at a revolute joint; absent: continuous"
    )
    step_m: Positive | None = Field(
        default=None, description="the servo's step, at a prismatic joint; absent: continuous"
    )
    encoder: Literal["motor", "joint"] = Field(
        default="motor",
        description="where a commanded joint is read: a motor's encoder sees neither play nor gear",
    )
    mimic: Mimic | list[Mimic] | None = Field(
        default=None, description="a passive joint; several terms are summed"
    )
    coupling: Coupling | None = Field(
        default=None, description="a commanded joint that counts with another one"
    )
    moves: bool = Field(
        default=True,
        description="false: a commanded joint beside the chain, which other rows mimic",
    )
    pose: Pose | None = Field(default=None, description="fixed rows: the whole transform")
    tolerance: Tolerance = Tolerance()
    drive: Literal["servo", "motor", "hydraulic", "cable"] = Field(
        default="servo", description="what moves the joint: decides what a report advises"
    )
    cylinder: Cylinder | None = Field(
        default=None, description="the pins of the cylinder that turns a revolute joint"
    )

    def check_together(self) -> None:
        given = {"limits_deg": self.limits_deg, "limits_m": self.limits_m}
        key = {"revolute": "limits_deg", "prismatic": "limits_m"}.get(self.type)
        if self.type == "fixed" and self.mimic:
            raise Misdeclared("mimic", self.mimic, "none in a fixed row")
        if self.coupling and not (self.commanded and self.moves):
            raise Misdeclared("coupling", "given", "in the row of a commanded joint that moves")
        if not self.moves and not self.commanded:
            raise Misdeclared("moves", False, "true, but in the row of a commanded joint")
        if self.pose is not None and self.type != "fixed":
            allowed = "in fixed rows only; use a_m, alpha_deg, d_m, theta_offset_deg"
            raise Misdeclared("pose", f"given in a {self.type} row", allowed)
        if self.endless and (self.cylinder or self.type != "revolute" or not self.commanded):
            raise Misdeclared("endless", True, "at commanded revolute joints without a cylinder")
        for name, limits in given.items():
            if limits is None:
                continue
            if name != key:
                allowed = f"{key} for a {self.type} joint" if key else "none in a fixed row"
                raise Misdeclared(name, list(limits), allowed)
            if not limits[0] < limits[1]:
                raise Misdeclared(name, list(limits), "[lower, upper] with lower < upper")
        if key is not None and not self.mimic and given[key] is None and not self.endless:
            raise Misdeclared(key, "missing", f"[lower, upper] of a commanded {self.type} joint")
        self._check_step(key)
        if self.cylinder is not None:
            if self.type != "revolute" or not self.commanded:
                raise Misdeclared("cylinder", "given", "at commanded revolute joints only")
            ends = [math.degrees(self.cylinder.angle(q)) for q in self.limits]
            if not 0 < min(ends) < max(ends) < 180:
                span = " to ".join(f"{end:.1f}" for end in sorted(ends))
                allowed = "over the joint's limits within 0 to 180 (there the pins are in line)"
                raise Misdeclared("cylinder.angle_deg", span, allowed)

    def _check_step(self, key: str | None) -> None:
        mine = key.replace("limits", "step") if key and not self.mimic else None
        for name, step in (("step_deg", self.step_deg), ("step_m", self.step_m)):
            if step is not None and name != mine:
                driven = "a passive" if self.mimic else "a fixed"
                allowed = f"{mine} for a {self.type} joint" if mine else f"none in {driven} row"
                raise Misdeclared(name, step, allowed)
            if step is not None and self.limits[1] - self.limits[0] < self.step:
                raise Misdeclared(name, step, "at most the joint's range, upper less lower limit")

    @property
    def commanded(self) -> bool:
        """True if a motor drives this row."""
        return self.type != "fixed" and not self.mimic

    @property
    def mimics(self) -> list[Mimic]:
        """The joints that add to this row's value: its `mimic` terms, or its `coupling`."""
        if self.coupling is not None:
            return [Mimic(joint=self.coupling.joint, multiplier=self.coupling.factor)]
        if self.mimic is None:
            return []
        return self.mimic if isinstance(self.mimic, list) else [self.mimic]

    @property
    def limits(self) -> tuple[float, float]:
        """Lower and upper limit in rad or m.

        Without declared limits they are +-pi for an endless joint, else infinite.
        """
        if self.limits_deg is not None:
            return math.radians(self.limits_deg[0]), math.radians(self.limits_deg[1])
        if self.endless:
            return -math.pi, math.pi
        return self.limits_m if self.limits_m is not None else (-math.inf, math.inf)

    @property
    def step(self) -> float:
        """The servo's step in rad or m; 0 if none is declared."""
        return math.radians(self.step_deg) if self.step_deg is not None else self.step_m or 0.0
