"""Parts with play or friction: each rests on the side to which a load or a motion pushed it."""

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.history import SLIDE
from longarm_comp.core.arm.parts import Beam
from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.effects.effect import Parameter, form, parameter
from longarm_comp.core.effects.joint_term import JointTerm, RestingTerm
from longarm_comp.core.effects.typical_loads import typical_loads


@dataclass(frozen=True)
class Backlash(RestingTerm):
    """A joint with play rests half the play off, on the side to which the gravity torque pushes it.

    If the torque is below a threshold, friction holds the joint on the side that it came from.
    """

    name = "backlash"
    title = "play"
    types = ("revolute", "prismatic")
    action = "Tighten or replace the gear, coupling or clamp of the joint."
    actions: ClassVar = {
        "hydraulic": "Renew worn pins and bushes of the cylinder and the joint.",
        "cable": "Raise the cables' pretension; look for worn sheaves.",
    }
    needs = ("approach",)
    limit_aliases = ("friction_hysteresis",)  # load decides nowhere

    width: float = parameter("rad", "full width of the play", prior=0.02, lower=0.0)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the parameter, with a prior of 20 mrad, or 0.5 mm for a slide."""
        return self.with_prior(5e-4, unit="m") if self.slides(arm) else self.declared()

    def twists(self, posture: Posture) -> Twists:
        return self.motion(posture, (0.5 * self.width) * self.side(posture))


@dataclass(frozen=True)
class ServoDeadband(Backlash):
    """A servo with a deadband stops within it, as a joint with play does, but before its encoder.

    Only a reading of the joint can distinguish it from play.
    """

    name = "servo_deadband"
    title = "deadband of a servo"
    acts = "servo"
    action = "Narrow the deadband of the servo, or add integral action."
    actions: ClassVar = {"hydraulic": "Check the valve for its deadband; add integral action."}
    aliases = ("backlash",)


@dataclass(frozen=True)
class CylinderPlay(RestingTerm):
    """Worn pins shift the cylinder by a play, as `backlash` shifts a joint.

    The joint turns by half the play over the lever of the cylinder.
    """

    name = "cylinder_play"
    title = "play in the cylinder's pins"
    action = "Renew the pins and bushes of the cylinder."
    needs = ("approach",)

    width: float = parameter("m", "play of both pins along the cylinder", prior=1e-3, lower=0.0)

    @classmethod
    def fits(cls, arm: Arm, row: int) -> bool:
        return arm.joints[row - 1].cylinder is not None

    def twists(self, posture: Posture) -> Twists:
        cylinder = posture.arm.joints[self.joint - 1].cylinder
        assert cylinder is not None
        lever = spatial.absolute(cylinder.lever(self.command(posture)))
        return self.motion(posture, 0.5 * self.width / lever * self.side(posture))


@dataclass(frozen=True)
class FrictionHysteresis(JointTerm):
    """A joint with friction stops short of its goal, on the side that it came from.

    A joint with friction and wind-up lags behind its motion (Prandtl-Ishlinskii model, a sum of
    play operators).  One part of the lag reverses at once with the direction of motion.  Two other
    parts reverse gradually over a motion of twice a radius, so after a short move they still
    depend on the moves before.  The data determine the sum, `width`, much better than its parts.

    Attributes:
        near, far: radii of the two gradual operators, rad; for a slide a tenth of the number, in m.
        run_up: length, in the unit of the radii, that was assumed for run-ups of unknown length in
            the fitted session; 0: there were none.
    """

    name = "friction_hysteresis"
    title = "friction"
    types = ("revolute", "prismatic")
    action = "Clean and grease the joint; look for dragging seals and cables."
    actions: ClassVar = {
        "hydraulic": "Check the cylinder's seals and guides, and the valve's deadband.",
        "cable": "Clean and grease sheaves and conduits; look for cables that rub.",
    }
    needs = ("approach",)

    near: float = form(0.04, lower=0.01, upper=0.6)
    far: float = form(0.15, lower=0.01, upper=0.6)
    run_up: float = form(0.0)
    width: float = parameter("rad", "full width, from side to side", prior=0.01, lower=0.0)
    inner: float = parameter("rad", "part that winds up over `near`", prior=3e-3, lower=0.0)
    outer: float = parameter("rad", "part that winds up over `far`", prior=3e-3, lower=0.0)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the parameters, with priors of 10, 3 and 3 mrad; 0.3, 0.1, 0.1 mm for a slide."""
        if not self.slides(arm):
            return self.declared()
        return self.with_prior(3e-4, 1e-4, 1e-4, unit="m")

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("approach", "legs")

    def twists(self, posture: Posture) -> Twists:
        scale = SLIDE if self.slides(posture.arm) else 1.0
        side = self.direction(posture)
        lag = self.width * side
        for part, radius in ((self.inner, self.near), (self.outer, self.far)):
            lag = lag + part * (self.wound(posture, scale * radius) - side)
        return self.motion(posture, -0.5 * lag)


@dataclass(frozen=True)
class TelescopeClearance(JointTerm):
    """A sliding beam tilts in its guide by ``clearance / overlap + give * moment / overlap^2``.

    The overlap is the length of the sliding body inside the beam before it; the tilt acts at the
    mouth of that beam, in the direction of the moment there.  The first part does not depend on
    the size of the moment.  The second one is the compression of the pads at both ends of the
    overlap: each carries a force of moment / overlap.
    """

    name = "telescope_clearance"
    title = "clearance in the telescope"
    action = "Adjust or replace the guide pads; a longer overlap lowers it."
    loaded = True

    clearance: float = parameter("m", "play of the body in its guide", prior=3e-4, lower=0.0)
    give: float = parameter("m/N", "compression of both pads together per force", 1e-5, lower=0.0)

    @classmethod
    def fits(cls, arm: Arm, row: int) -> bool:
        """Tell whether a row is prismatic and has a beam that slides in the one before it."""
        return arm.joints[row - 1].type == "prismatic" and _slider(arm, row) is not None

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the parameters; the prior of `give` tilts the beam by 3 mrad.

        That is at the arm's typical torque and an overlap of half the body.
        """
        slider = _slider(arm, self.joint)
        body = (slider and slider.body_length_m) or 1.0
        clearance, give = self.declared()
        prior = 3e-3 * (body / 2) ** 2 / typical_loads(arm).torque
        return clearance, dataclasses.replace(give, prior=prior)

    def twists(self, posture: Posture) -> Twists:
        """Return a rotation (rad) about the lateral moment, at the mouth of the outer beam."""
        slider = _slider(posture.arm, self.joint)
        assert slider is not None and slider.body_length_m is not None
        elements = posture.chain.rows[self.joint - 1].elements_d
        mouth = posture.bearing(self.joint)
        out: spatial.Scalar = 0.0
        for e in elements:
            if e.beam is slider:
                out = out + posture.lengths[e.station]
            else:
                mouth = e.station
        overlap = slider.body_length_m - out
        x, y, _ = posture.moment(mouth)
        size = spatial.sqrt(x * x + y * y + 1e-12)
        tilt = self.clearance / (overlap * size) + self.give / (overlap * overlap)
        return {mouth: (0.0, 0.0, 0.0, tilt * x, tilt * y, 0.0)}


def _slider(arm: Arm, row: int) -> Beam | None:
    """Return the beam of a row whose body overlaps the beam before it over the joint's range."""
    beams = [b for b in arm.links if b.row == row and b.role == "d"]
    joint = arm.joints[row - 1]
    for beam in beams[1:]:
        if beam.length_m == "rest" and beam.body_length_m is not None:
            fixed = sum(b.length_m for b in beams if b.length_m != "rest")
            if beam.body_length_m > joint.d_m + joint.limits[1] - fixed:
                return beam
    return None


@dataclass(frozen=True)
class SlidePlay(JointTerm):
    """A carriage of constant length tilts by ``tilt`` in the direction of the moment it carries.

    If the sliding body and its guide are declared as beams, the overlap changes with the extension,
    and `telescope_clearance` is used instead.
    """

    name = "slide_play"
    title = "tilting carriage"
    action = "Adjust the preload of the carriage or replace its rollers."
    loaded = True

    tilt: float = parameter("rad", "half of the carriage's free angle", 3e-3, lower=0.0)

    @classmethod
    def fits(cls, arm: Arm, row: int) -> bool:
        prismatic = arm.joints[row - 1].type == "prismatic"
        return prismatic and not TelescopeClearance.fits(arm, row)

    def twists(self, posture: Posture) -> Twists:
        station = posture.frame(self.joint)
        x, y, _ = posture.moment(station)
        tilt = self.tilt / spatial.sqrt(x * x + y * y + 1e-12)
        return {station: (0.0, 0.0, 0.0, tilt * x, tilt * y, 0.0)}
