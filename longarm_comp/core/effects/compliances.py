"""Parts that yield under load: joints, bearings, links, the base."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from typing_extensions import Self

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.joint import Joint
from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.arm.spatial import Scalar
from longarm_comp.core.effects.effect import Effect, Parameter, Sites, form, parameter, place
from longarm_comp.core.effects.joint_term import JointTerm
from longarm_comp.core.effects.link_deflection import cantilever, extra_sag
from longarm_comp.core.effects.sites import beams, rows
from longarm_comp.core.effects.typical_loads import reach, typical_loads


@dataclass(frozen=True)
class JointCompliance(JointTerm):
    """Linear torsion of gear, shaft and servo: ``dq = compliance * torque`` (Khalil & Besnard).

    A prismatic joint yields along its axis, with a compliance in m/N.

    Attributes:
        follows: whether rows that are coupled to the joint follow its torsion: 1 if a linkage
            drives them, 0 if only the controller couples them.
    """

    name = "joint_compliance"
    title = "soft joint"
    action = "Check keys, clamps and screws of the drive; a stiffer gear or shaft lowers it."
    actions: ClassVar = {
        "hydraulic": "Bleed cylinder and hoses of air; check hoses, pins and the valve's leakage.",
        "cable": "Use stiffer cables or raise their pretension; check their anchors.",
    }
    passive = True
    loaded = True
    elastic = True

    compliance: float = parameter("rad/(N m)", "torsion per gravity torque", prior=4e-3, lower=0.0)
    follows: int = form(1, tried=(1, 0))

    @classmethod
    def candidates(cls, arm: Arm) -> list[tuple[Self, ...]]:
        """Return every joint; a joint with coupled rows also in the form `follows` 0."""
        mixing, _ = arm.mixing
        led = {row for k, row in enumerate(arm.commanded) if np.count_nonzero(mixing[:, k]) > 1}
        alone = {row for row in led if mixing[row - 1, arm.commanded.index(row)] != 0.0}
        return [(t,) for (t,) in super().candidates(arm) if t.follows or t.joint in alone]

    @classmethod
    def for_arm(cls, arm: Arm) -> tuple[Self, ...]:
        return tuple(t for t in super().for_arm(arm) if t.follows)

    def moved_rows(self, posture: Posture) -> tuple[tuple[int, float], ...]:
        return super().moved_rows(posture) if self.follows else ((self.joint, 1.0),)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the parameter; its prior is 20 mrad under the typical torque of its place.

        For a slide it is 0.2 % of the reach under the arm's weight.  Fits of real arms, with all
        bearings soft too, gave 43 to 75 mrad for Justin, 18 and 24 for a WAM, up to 11 for Pandas.
        """
        loads = typical_loads(arm)
        if self.slides(arm):
            return self.with_prior(0.002 * reach(arm) / loads.force, unit="m/N")
        return self.with_prior(0.02 / loads.at(self.joint))

    def twists(self, posture: Posture) -> Twists:
        return self.motion(posture, self.compliance * self.load(posture))


@dataclass(frozen=True)
class ServoDroop(JointCompliance):
    """A servo with proportional control stands off its goal in proportion to the load.

    The encoder of the servo sees this. Only a reading of the joint can distinguish it from a soft
    joint.
    """

    name = "servo_droop"
    title = "servo that yields to its load"
    types = ("revolute", "prismatic")
    passive = False
    elastic = False
    acts = "servo"
    action = "Raise the gain of the servo or add integral action; otherwise fit a stronger one."
    actions: ClassVar = {
        "hydraulic": "Add integral action to the valve's controller, or check it for leakage.",
        "motor": "Raise the gain of the position controller, or add integral action.",
        "cable": "Raise the gain of the position controller, or measure the angle at the joint.",
    }
    aliases = ("joint_compliance",)


@dataclass(frozen=True)
class BearingTilt(JointTerm):
    """Lateral elasticity of a joint: its seat tilts under the moment perpendicular to its axis.

    The seat belongs to the link before the joint, so its two axes do not turn with the joint: x is
    that link's ``x_{i-1}`` (the lateral term of Tenhumberg & Baeuml, HUMANOIDS 2021), and y' is
    perpendicular to it.  On their arms these axes leave errors of 3.7 mm, and axes that turn with
    the joint 3.9 mm.
    """

    name = "bearing_tilt"
    title = "soft bearing"
    action = "Check seat and preload of the bearing; replace it if it rocks by hand."
    passive = True
    loaded = True
    elastic = True

    about_x: float = parameter("rad/(N m)", "tilt about x_{i-1} per moment", 2e-3, 0.0, like="seat")
    about_y: float = parameter("rad/(N m)", "tilt about y' per moment", 2e-3, 0.0, like="seat")

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the parameters; their priors are 10 mrad under the typical torque of the place.

        Fits of the first bearings of real arms gave 11 to 18 mrad for Justin, 1 for a UR5, 0.2 to 4
        for Pandas.
        """
        return self.with_prior(0.01 / typical_loads(arm).at(self.joint))

    def twists(self, posture: Posture) -> Twists:
        """Return the rotation (rad) about the seat's lateral axes, in the bearing's axes."""
        station = posture.bearing(self.joint)
        x, y, _ = posture.moment(station)
        joint = posture.arm.joints[self.joint - 1]
        theta: Scalar = math.radians(joint.theta_offset_deg)
        if joint.type == "revolute":
            theta = theta + posture.values[self.joint - 1]
        c, s = spatial.cos(theta), spatial.sin(theta)
        tilt_x, tilt_y = self.about_x * (c * x - s * y), self.about_y * (s * x + c * y)
        return {station: (0.0, 0.0, 0.0, c * tilt_x + s * tilt_y, c * tilt_y - s * tilt_x, 0.0)}


@dataclass(frozen=True)
class LinkBending(Effect):
    """A link without a declared beam bends: a straight cantilever from one frame to the next.

    With r from the frame before to this one, of length l, and the force F and moment M at its end,
    the end turns by ``(l M_across + l/2 r x F) / EI + l M_along / GJ`` and moves by
    ``(l/2 M x r + l/3 (r x F) x r) / EI`` (Euler-Bernoulli).  The length of a slide is its present
    extension.
    """

    name = "link_bending"
    title = "undeclared bending of a link"
    action = "Declare the link's beam in arm.yaml; check its clamping. A stiffer profile lowers it."
    loaded = True
    elastic = True

    row: int = place(rows)
    bending: float = parameter("1/(N m^2)", "1 / EI of the link", prior=1e-4, lower=0.0)
    torsion: float = parameter("1/(N m^2)", "1 / GJ of the link", prior=1e-4, lower=0.0)

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        """Return every row that has a length and no declared beam."""
        declared = {beam.row for beam in arm.links}
        return [{"row": j.id} for j in arm.joints if j.id not in declared and _long(j)]

    def price(self, arm: Arm) -> float:
        """Return the log of the number of all links over the number of links without a beam.

        A link with a declared beam is as likely to be the cause, so it gets its part of the prior.
        """
        return math.log(sum(map(_long, arm.joints)) / len(self.sites(arm)))

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the parameters; their prior lets a quarter of the reach bend by 10 mrad.

        That is under the typical torque at the start of the link.
        """
        return self.with_prior(0.01 / (typical_loads(arm).at(self.row - 1) * reach(arm) / 4))

    def twists(self, posture: Posture) -> Twists:
        start, station = posture.frame(self.row - 1), posture.frame(self.row)
        end = posture.frames[station]
        r = end.unrotate(spatial.sub(end.p, posture.frames[start].p))
        length: Scalar = spatial.sqrt(spatial.dot(r, r) + 1e-12)  # m^2: a point has no direction
        force, moment = posture.force(station), posture.moment(station)
        lever = spatial.cross(r, force)
        along = spatial.scale(spatial.dot(r, moment) / length, r)
        across = spatial.sub(spatial.scale(length, moment), along)
        turn = spatial.scale(self.bending, spatial.add(across, spatial.scale(0.5 * length, lever)))
        turn = spatial.add(turn, spatial.scale(self.torsion, along))
        bow = spatial.add(spatial.scale(length / 2, moment), spatial.scale(length / 3, lever))
        return {station: (*spatial.cross(spatial.scale(self.bending, bow), r), *turn)}


def _long(joint: Joint) -> bool:
    return joint.pose is not None or joint.type == "prismatic" or joint.a_m != 0 or joint.d_m != 0


@dataclass(frozen=True)
class BaseCompliance(Effect):
    """Soft ground, floor or carrier: the base tilts about x and y in proportion to the moments.

    Each axis has its own compliance, because a carrier is rarely as soft along as across.  If the
    first bearing has the same pivot as the base, `bearing_tilt` of the first joint is equal to it.
    """

    name = "base_compliance"
    title = "soft base"
    whole = "base"
    action = "Tighten the bolts of the base, brace its stand, or put it on firm ground."
    loaded = True

    about_x: float = parameter("rad/(N m)", "tilt about x per moment", prior=2e-3, lower=0.0)
    about_y: float = parameter("rad/(N m)", "tilt about y per moment", prior=2e-3, lower=0.0)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the parameters; their priors are 10 mrad under the arm's typical torque."""
        return self.with_prior(0.01 / typical_loads(arm).torque)

    def twists(self, posture: Posture) -> Twists:
        x, y, _ = posture.moment(0)
        return {0: (0.0, 0.0, 0.0, self.about_x * x, self.about_y * y, 0.0)}


@dataclass(frozen=True)
class LinkStiffness(Effect):
    """Wrong E or section: the beam bends ``1 + softness`` times as much as declared."""

    name = "link_stiffness"
    title = "beam stiffness"
    action = "Compare section and material with arm.yaml; look for cracks and loose clamps."
    loaded = True

    beam: str = place(beams)
    softness: float = parameter(
        "1", "extra deflection over the declared one (EI true = EI / (1 + softness))", 0.5, -0.9
    )

    def twists(self, posture: Posture) -> Twists:
        return extra_sag(posture, self.softness, self.beam)


@dataclass(frozen=True)
class LinkTorsion(Effect):
    """Wrong G or section: the beam twists ``1 + softness`` times as much as declared.

    Torsion is known less well than bending: a wound tube may twist five times as much as its E
    tells, an open section a hundred times.  `bearing_tilt` at its end about its axis is the same
    motion under the same moment; that of `link_stiffness` adds to it.
    """

    name = "link_torsion"
    title = "beam torsion"
    action = "Compare section, lay-up and G with arm.yaml; a closed section twists less."
    loaded = True

    beam: str = place(beams)
    softness: float = parameter(
        "1", "extra twist over the declared one (GJ true = GJ / (1 + softness))", 1.0, -0.9
    )

    def twists(self, posture: Posture) -> Twists:
        made = {}
        for e in posture.chain.elements:
            if e.beam.name == self.beam:
                turn: list[Scalar] = [0.0, 0.0, 0.0]
                turn[e.axis] = self.softness * cantilever(posture, e)[3 + e.axis]
                made[e.station] = (0.0, 0.0, 0.0, *turn)
        return made
