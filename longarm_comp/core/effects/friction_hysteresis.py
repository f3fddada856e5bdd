"""Friction and wind-up: a joint stops short of its command, on the side it came from."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm.history import SLIDE
from longarm_comp.core.effects.effect import Arm, Parameter, Posture, Twists, form, parameter
from longarm_comp.core.effects.joint_term import JointTerm, by_drive, with_prior


@dataclass(frozen=True)
class FrictionHysteresis(JointTerm):
    """A joint stops short of its goal, on the side that it came from: a sum of play operators.

    A joint with friction and wind-up lags behind its motion (Prandtl-Ishlinskii): in part by its
    side of arrival at once, in part as it winds through twice a radius, so that a short move turns
    that part only a little and the rest remembers the moves before.  The data fix the sum, `width`,
    much better than its parts.

    Attributes:
        near, far: radii (rad; a tenth as many m for a slide) of the two operators that remember.
        run_up: length (as the radii) that run-ups of unrecorded length were taken to have in the
            session that it was fitted to; 0: there were none.
    """

    name = "friction_hysteresis"
    title = "friction"
    types = ("revolute", "prismatic")
    action = "Clean and grease the joint; look for dragging seals and cables."
    actions = by_drive(
        hydraulic="Check the cylinder's seals and guides, and the valve's deadband.",
        cable="Clean and grease sheaves and conduits; look for cables that rub.",
    )
    needs = ("approach",)
    remembers = True

    near: float = form(0.04, lower=0.01, upper=0.6)
    far: float = form(0.15, lower=0.01, upper=0.6)
    run_up: float = form(0.0)
    width: float = parameter("rad", "full width, from side to side", prior=0.01, lower=0.0)
    inner: float = parameter("rad", "part that winds up over `near`", prior=3e-3, lower=0.0)
    outer: float = parameter("rad", "part that winds up over `far`", prior=3e-3, lower=0.0)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Priors 10, 3 and 3 mrad, or 0.3, 0.1 and 0.1 mm for a slide."""
        if arm.joints[self.joint - 1].type != "prismatic":
            return self.declared()
        width, *parts = with_prior(self.declared(), unit="m", prior=1e-4)
        return *with_prior((width,), prior=3e-4), *parts

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("approach", "legs")

    def twists(self, posture: Posture) -> Twists:
        sliding = posture.arm.joints[self.joint - 1].type == "prismatic"
        scale = SLIDE if sliding else 1.0
        side = self.direction(posture)
        lag = self.width * side
        for part, radius in ((self.inner, self.near), (self.outer, self.far)):
            lag = lag + part * (self.wound(posture, scale * radius) - side)
        return self.motion(posture, -0.5 * lag)
