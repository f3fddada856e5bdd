"""Parts that give way under load: joints, bearings, links, the base."""

from __future__ import annotations

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
from longarm_comp.core.effects.link_deflection import extra_sag
from longarm_comp.core.effects.sites import beams, rows
from longarm_comp.core.effects.typical_loads import reach, typical_loads


@dataclass(frozen=True)
class JointCompliance(JointTerm):
    """Linear torsion of gear, shaft and servo: ``dq = compliance * torque`` (Khalil & Besnard).

    A prismatic joint gives way along its axis: m/N.  Rows that are coupled to the joint follow its
    torsion where a linkage drives them (`follows` 1), and do not where the controller couples them.
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
        """Return both forms only where other rows are coupled to a joint that moves."""
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
        """Return the prior: 20 mrad (2 % of the reach) under its place's torque (`typical_loads`).

        Gears, shafts and servos of a kind are as stiff as they are strong, by their catalogues.

        Fitted to real arms with all seats: Justin 43 to 75 mrad, WAM 18 and 24, Pandas up to 11.
        """
        loads = typical_loads(arm)
        if self.slides(arm):
            return self.with_prior(0.002 * reach(arm) / loads.force, unit="m/N")
        return self.with_prior(0.02 / loads.at(self.joint))

    def twists(self, posture: Posture) -> Twists:
        return self.motion(posture, self.compliance * self.load(posture))


@dataclass(frozen=True)
class ServoDroop(JointCompliance):
    """A joint gives way before its encoder: a proportional controller yields to its load.

    Only a reading of the joint tells it from a soft joint.
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
    """Lateral elasticity of a joint: its seat turns under the moment across its axis.

    The seat belongs to the link before the joint, so the two axes stand still when the joint
    turns: x is that link's ``x_{i-1}`` (the lateral term of Tenhumberg & Baeuml, HUMANOIDS
    2021), y is across it.  On their arms axes that turn with the joint leave 3.9 mm, these 3.7.
    """

    name = "bearing_tilt"
    title = "soft bearing"
    action = "Check seat and preload of the bearing; replace it if it rocks by hand."
    passive = True
    loaded = True
    elastic = True

    about_x: float = parameter(
        "rad/(N m)", "tilt about x_{i-1} per moment", prior=2e-3, lower=0.0, like="seat"
    )
    about_y: float = parameter(
        "rad/(N m)", "tilt about y' per moment", prior=2e-3, lower=0.0, like="seat"
    )

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the priors: 10 mrad under the torque of its place (`typical_loads`).

        First seats of real arms, fitted: Justin 11 to 18 mrad, UR5 1, Pandas 0.2 to 4.
        """
        return self.with_prior(0.01 / typical_loads(arm).at(self.joint))

    def twists(self, posture: Posture) -> Twists:
        """Return a rotation (rad) about the seat's lateral axes, seen in the bearing's axes."""
        station = posture.bearing(self.joint)
        x, y, _ = posture.moment(station)
        joint = posture.arm.joints[self.joint - 1]
        theta: Scalar = math.radians(joint.theta_offset_deg)
        if joint.type == "revolute":
            theta = theta + posture.values[self.joint - 1]
        c, s = spatial.cos(theta), spatial.sin(theta)
        tilt_x, tilt_y = self.about_x * (c * x - s * y), self.about_y * (s * x + c * y)
        return {station: (0.0, 0.0, 0.0, c * tilt_x + s * tilt_y, c * tilt_y - s * tilt_x, 0.0)}


_POINT = 1e-6  # m: a link shorter than this has no direction


@dataclass(frozen=True)
class LinkBending(Effect):
    """The straight way from one frame to the next is a cantilever of unknown stiffness.

    With r from the frame before to this one, of length l, and the force F and moment M at its end,
    the end turns by ``(l M_across + l/2 r x F) / EI + l M_along / GJ`` and moves by
    ``(l/2 M x r + l/3 (r x F) x r) / EI`` (Euler-Bernoulli).  A slide is as long as it is out.
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
        """Return every row with a length and without a declared beam."""
        declared = {beam.row for beam in arm.links}
        return [{"row": j.id} for j in arm.joints if j.id not in declared and _long(j)]

    def price(self, arm: Arm) -> float:
        """Return the log of all links with a length over those without a declared beam.

        A link with a declared beam may bend just as likely, so it has its share of the prior.
        """
        every = sum(map(_long, arm.joints))
        return math.log(every / len(self.sites(arm)))

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the priors: 10 mrad over a quarter of the reach under the torque at its start.

        A short bracket of that section turns by little, as the arm's own beams would.
        """
        return self.with_prior(0.01 / (typical_loads(arm).at(self.row - 1) * reach(arm) / 4))

    def twists(self, posture: Posture) -> Twists:
        start, station = posture.frame(self.row - 1), posture.frame(self.row)
        end = posture.frames[station]
        r = end.unrotate(spatial.sub(end.p, posture.frames[start].p))
        length: Scalar = spatial.sqrt(spatial.dot(r, r) + _POINT**2)
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
    """Soft ground, floor or carrier: tilt about x and y per moment about them.

    A carrier is rarely as soft along as across, so that each axis has its own compliance.  With
    both, it equals a bearing tilt of the first joint where the two have the same pivot.
    """

    name = "base_compliance"
    title = "soft base"
    whole = "base"
    action = "Tighten the bolts of the base, brace its stand, or put it on firm ground."
    loaded = True

    about_x: float = parameter("rad/(N m)", "tilt about x per moment", prior=2e-3, lower=0.0)
    about_y: float = parameter("rad/(N m)", "tilt about y per moment", prior=2e-3, lower=0.0)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the priors: 10 mrad under the arm's typical torque (`typical_loads`)."""
        return self.with_prior(0.01 / typical_loads(arm).torque)

    def twists(self, posture: Posture) -> Twists:
        x, y, _ = posture.moment(0)
        return {0: (0.0, 0.0, 0.0, self.about_x * x, self.about_y * y, 0.0)}


@dataclass(frozen=True)
class LinkStiffness(Effect):
    """Wrong E or section: the beam bends by ``1 + softness`` times what is declared."""

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
