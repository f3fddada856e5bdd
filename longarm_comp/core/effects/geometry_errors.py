"""Errors of the arm's geometry and of its encoders: rows, zeros, cylinder pins, readings."""

import dataclasses
import math
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.arm.spatial import Scalar, Vec
from longarm_comp.core.effects.effect import Bias, Effect, Parameter, Sites, form, parameter, place
from longarm_comp.core.effects.joint_term import JointTerm
from longarm_comp.core.effects.sites import moving_joints, rows
from longarm_comp.core.effects.typical_loads import reach
from longarm_comp.core.errors import InputError


@dataclass(frozen=True)
class JointZero(JointTerm):
    """The joint stands at ``q + offset``: the encoder's or servo horn's zero is off."""

    name = "joint_zero"
    title = "zero offset"
    types = ("revolute", "prismatic")
    action = "Set the zero of the servo or encoder again."
    actions: ClassVar = {
        "hydraulic": "Set the zero of the joint's angle or length sensor again.",
        "motor": "Reference the axis again, or set the encoder's zero.",
        "cable": "Reference the joint again; look for a cable that slipped or stretched.",
    }
    geometry = True
    slips = True
    displaces_joint = True

    offset: float = parameter("rad", "joint value at command zero", prior=4e-3)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the parameter; its prior is the row's tolerance, else 4 mrad or 1 mm."""
        joint = arm.joints[self.joint - 1]
        if joint.type == "prismatic":
            return self.with_prior(joint.tolerance.d_m or 1e-3, unit="m")
        declared = joint.tolerance.theta_deg
        return self.with_prior(math.radians(declared) if declared else 4e-3)

    def twists(self, posture: Posture) -> Twists:
        return self.motion(posture, self.offset)


ELSEWHERE = 0.25
"""Largest plausible length error, and error of a measured tip, as a fraction of the arm's size.

If the errors are larger, it is another arm, or it stands at another place.
"""


@dataclass(frozen=True)
class DhError(Effect):
    """Manufacturing and assembly errors of one row.

    ``a`` and ``alpha`` act along and about ``x_{i-1}``, ``b`` and ``beta`` along and about
    ``y_{i-1}`` (``beta`` is Hayati's parameter, which parallel axes need; ``b`` is the length of a
    link that a fixed transform lays along y), ``d`` and ``theta`` along and about ``z_i``.
    The set is redundant on purpose; the priors make the fit unique.  Of a commanded joint,
    ``theta`` (of a slide, ``d``) is fixed at 0: `joint_zero` fits it.
    """

    name = "dh_error"
    title = "geometry error"
    action = "Nothing to repair: parts differ from the drawing; calibrate after every assembly."
    geometry = True

    row: int = place(rows)
    a: float = parameter("m", "link length error along x_{i-1}", prior=1e-3)
    b: float = parameter("m", "link offset error along y_{i-1}", prior=1e-3)
    alpha: float = parameter("rad", "twist error about x_{i-1}", prior=4e-3)
    beta: float = parameter("rad", "tilt error about y_{i-1}", prior=4e-3)
    d: float = parameter("m", "offset error along z_i", prior=1e-3)
    theta: float = parameter("rad", "angle error about z_i", prior=4e-3)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the parameters, with the row's tolerances as priors (0 for the joint variable)."""
        joint = arm.joints[self.row - 1]
        held = joint.tolerance
        a, d = held.a_m or 1e-3, held.d_m or 1e-3
        alpha, theta = (math.radians(v) if v else 4e-3 for v in (held.alpha_deg, held.theta_deg))
        priors = {"a": a, "b": a, "alpha": alpha, "beta": alpha, "d": d, "theta": theta}
        if joint.commanded:
            priors["theta" if joint.type == "revolute" else "d"] = 0.0
        return self.with_prior(*priors.values())

    def check(self, arm: Arm, where: str) -> None:
        """Raise InputError if a length error exceeds `ELSEWHERE`, a quarter, of the arm's reach."""
        most = ELSEWHERE * reach(arm)
        for p in self.declared():
            value = getattr(self, p.name)
            if p.unit == "m" and abs(value) > most:
                allowed = f"within +-{most:.3g} m, a quarter of the arm's reach"
                raise InputError(where, f"{self.name}.{p.name} at {self.where}", value, allowed)

    def twists(self, posture: Posture) -> Twists:
        """Return ``[a b 0; alpha beta 0]`` in frame i-1, ``[0 0 d; 0 0 theta]`` in frame i.

        The axis tilts about the point that `Chain.tilted_at` gives.
        """
        a, b, off = self.a, self.b, posture.chain.tilted_at[self.row - 1]
        if off:
            a, b = a - off * self.beta, b + off * self.alpha
        return {
            posture.frame(self.row - 1): (a, b, 0.0, self.alpha, self.beta, 0.0),
            posture.frame(self.row): (0.0, 0.0, self.d, 0.0, 0.0, self.theta),
        }


@dataclass(frozen=True)
class CylinderPins(JointTerm):
    """A joint driven by a cylinder stands wrong because the pins are not where they were declared.

    The error is that of the law of cosines at a fixed cylinder length, to first order in the
    places of the pins.  A scale error of the cylinder's length sensor has the same effect as a
    relative error of both distances.
    """

    name = "cylinder_pins"
    title = "places of the cylinder's pins"
    action = (
        "Measure the distances from the joint's axis to both pins; set the length sensor's scale."
    )
    geometry = True

    near: float = parameter("m", "distance of the pin before the joint", prior=2e-3)
    far: float = parameter("m", "distance of the pin on the part that turns", prior=2e-3)
    length: float = parameter("m", "length at which the sensor reads zero", prior=2e-3)

    @classmethod
    def fits(cls, arm: Arm, row: int) -> bool:
        return arm.joints[row - 1].cylinder is not None

    def twists(self, posture: Posture) -> Twists:
        """Turn the joint by ``(length L - near (a - b cos) - far (b - a cos)) / (L lever)``."""
        cylinder = posture.arm.joints[self.joint - 1].cylinder
        assert cylinder is not None
        q = self.command(posture)
        a, b, cosine = cylinder.near_m, cylinder.far_m, spatial.cos(cylinder.angle(q))
        pins = self.near * (a - b * cosine) + self.far * (b - a * cosine)
        missing = self.length - pins / cylinder.length(q)
        return self.motion(posture, missing / cylinder.lever(q))


@dataclass(frozen=True)
class Encoder(Bias):
    """An encoder reads ``zero + (1 + scale) q``.

    The scale of a potentiometer is right to about one hundredth.  Its zero is unknown.
    """

    name = "encoder"
    title = "encoder"
    action = "Nothing to repair; set its zero if it matters."
    geometry = True
    sees = frozenset({"joint"})

    joint: int = place(moving_joints)
    zero: float = parameter("rad", "reading where the joint is at 0", 4e-3, unknown=True)
    scale: float = parameter("1", "extra reading per motion", 0.01)

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        return [{"joint": row} for row in arm.commanded]

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        zero, scale = self.declared()
        if arm.joints[self.joint - 1].type == "prismatic":
            return (dataclasses.replace(zero, unit="m", prior=1e-3), scale)
        return zero, scale

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        return point

    def read(self, value: Scalar, row: int) -> Scalar:
        return self.zero + (1.0 + self.scale) * value if row == self.joint else value


@dataclass(frozen=True)
class KindDirection(Effect):
    """A usual difference between arms of the same kind: a combination of errors, with one amount.

    It is fitted instead of a correlated prior (`core/calibration/kind_of_arm.py`), and its errors
    are then added to those of the single effects.  It is never written into model.yaml.
    """

    name = "kind_direction"
    title = "usual difference between arms of this kind"
    geometry = True
    passing = True
    searched = False

    number: int = place()
    terms: tuple[Effect, ...] = form(())  # type: ignore[arg-type]
    amount: float = parameter("", "amount, in standard deviations among the arms", 1.0)

    @property
    def loaded(self) -> bool:  # type: ignore[override]
        return any(term.loaded for term in self.terms)

    def twists(self, posture: Posture) -> Twists:
        """Return `amount` times the sum of its terms' twists, which are linear in their values."""
        return spatial.sum_twists(
            {s: tuple(self.amount * v for v in t) for s, t in term.twists(posture).items()}  # type: ignore[misc]
            for term in self.terms
        )
