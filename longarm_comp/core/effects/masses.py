"""Weight that differs from the declared one: in size, in place, or in direction."""

from collections.abc import Iterator
from dataclasses import dataclass

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.posture import Lumped, Posture, Twists
from longarm_comp.core.arm.spatial import ZERO, Scalar, Vec, add, cross
from longarm_comp.core.effects.effect import Effect, Parameter, Sites, parameter, place
from longarm_comp.core.effects.sites import moving_joints, rows
from longarm_comp.core.effects.typical_loads import typical_loads


@dataclass(frozen=True)
class _Weight(Effect):
    """An effect without a twist of its own: it acts through the elastic effects of the model."""

    loaded = True

    def twists(self, posture: Posture) -> Twists:
        return {}


@dataclass(frozen=True)
class TipPayload(_Weight):
    """The tip carries more (or less) than declared."""

    name = "tip_payload"
    title = "load at the tip"
    whole = "tip"
    part = "declares_weight"  # else `undeclared_weight` has it
    action = "Weigh what the tip carries and declare it in arm.yaml."

    mass: float = parameter("kg", "mass beyond the declared payload", prior=0.1)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the parameter; its lower bound is minus the declared payload."""
        weight = typical_loads(arm).force / 9.81
        held = arm.payload.mass_kg if arm.payload else 0.0
        return self.with_prior(max(0.1 * weight, 1e-6), lower=-held)

    def masses(self, posture: Posture) -> tuple[Lumped, ...]:
        at = posture.arm.payload or posture.arm.tip
        return (Lumped(posture.frame(at.frame), self.mass, at.position_m),)


@dataclass(frozen=True)
class LinkMass(_Weight):
    """The arm is heavier (or lighter) at a row than declared: links, drives, cables, hoses.

    The mass is lumped at the frame's origin.  A mass between two frames is a part at each of them.
    """

    name = "link_mass"
    title = "mass along the arm"
    action = (
        "Weigh the links with all that they carry (drives, cables, hoses) and correct arm.yaml."
    )

    frame: int = place(rows)
    mass: float = parameter("kg", "mass beyond the declared ones", prior=0.1)

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        """Return each frame that declared beams carry, except the frame of `tip_payload`."""
        first = min((beam.row for beam in arm.links), default=len(arm.joints))
        tip = (arm.payload or arm.tip).frame
        return [{"frame": row} for row in rows(arm) if first < row and row != tip]

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the parameter, with a tenth of the arm's mass as prior, kg."""
        return self.with_prior(max(0.1 * typical_loads(arm).force / 9.81, 1e-6))

    def masses(self, posture: Posture) -> tuple[Lumped, ...]:
        return (Lumped(posture.frame(self.frame), self.mass, ZERO),)


@dataclass(frozen=True)
class UndeclaredWeight(_Weight):
    """The weight of an arm that declares none: one kilogram per metre of its links.

    A part of it may be at the tip instead.  A session shows only the products of weights and
    compliances.  So the weight of links, joints (`undeclared_drive`) and tip together is fixed, and
    compliances are relative to it.  Only the guides of slides add to it.
    """

    name = "undeclared_weight"
    title = "weight that is not declared"
    action = "Weigh the parts with all that they carry, and declare them in arm.yaml."
    searched = False
    through_others = True

    tip: float = parameter("kg", "what weighs at the tip, not along the links", 0.3, lower=0.0)
    guides: float = parameter("kg", "mass a metre of what every slide moves in", 1.0, lower=0.0)

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        return [] if arm.declares_weight else [{}]

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the parameters; the prior of `tip` is an equal part for each joint and the tip.

        That of `guides`, which only arms with slides have, is 1 kg/m, as for a slide.
        """
        shares = self.with_prior(_share(arm), 1.0)
        return shares if _guides(arm) else shares[:1]

    def masses(self, posture: Posture) -> tuple[Lumped, ...]:
        arm = posture.arm
        tip = Lumped(posture.frame(arm.tip.frame), self.tip, arm.tip.position_m)
        guides = (
            Lumped(posture.bearing(row), self.guides * abs(size), (0.0, 0.0, size / 2))
            for row, size in _guides(arm)
        )
        return (tip, *guides, *_along_links(posture, arm.usual_mass_kg - self.tip))


@dataclass(frozen=True)
class UndeclaredDrive(_Weight):
    """Weight at one joint, of an arm that declares no weight; the links get less by as much.

    It is for instance the motor at an elbow, or a gripper at the wrist.  Weight at the first joints
    bends nothing, so there it only makes the links lighter.
    """

    name = "undeclared_drive"
    title = "weight at a joint that is not declared"
    action = "Weigh the drive with all that it carries, and declare it in arm.yaml."
    searched = False
    through_others = True

    joint: int = place(moving_joints)
    mass: float = parameter("kg", "what weighs at the joint, not along the links", 0.3, lower=0.0)

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        return [] if arm.declares_weight else [{"joint": row} for row in moving_joints(arm)]

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        return self.with_prior(_share(arm))

    def masses(self, posture: Posture) -> tuple[Lumped, ...]:
        here = Lumped(posture.frame(self.joint), self.mass, ZERO)
        return (here, *_along_links(posture, -self.mass))


def _share(arm: Arm) -> float:
    """Return the prior of a weight: an equal part (kg) for each joint and the tip."""
    return arm.usual_mass_kg / (len(moving_joints(arm)) + 1)


def _along_links(posture: Posture, mass: Scalar) -> Iterator[Lumped]:
    """Distribute a mass (kg) along the links, in proportion to their lengths."""
    share = mass / posture.arm.usual_mass_kg
    every = posture.arm.usual_masses
    return (Lumped(posture.frame(row), share * usual, at) for row, at, usual in every)


def _guides(arm: Arm) -> list[tuple[int, float]]:
    """List each slide's row and the length of its guide, m, which is its ``d_m`` in arm.yaml."""
    return [(j.id, j.d_m) for j in arm.joints if j.type == "prismatic" and j.d_m]


@dataclass(frozen=True)
class GravityDirection(_Weight):
    """Gravity turned by two small angles about the base's x and y.

    A base levelled by eye or with a spirit level may lean by some 5 mrad; this is no finding.
    """

    name = "gravity_direction"
    title = "base out of level"
    whole = "base"
    action = "Level the base, or declare the direction of gravity."

    about_x: float = parameter("rad", "lean of gravity about base x", prior=0.03, usual=5e-3)
    about_y: float = parameter("rad", "lean of gravity about base y", prior=0.03, usual=5e-3)

    def gravity(self, gravity: Vec) -> Vec:
        return add(gravity, cross((self.about_x, self.about_y, 0.0), gravity))
