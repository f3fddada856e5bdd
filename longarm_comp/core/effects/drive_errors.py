"""Errors of how far a joint goes for its command: ratio, pitch, eccentric parts, guides, servos."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import Self

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.effects.effect import Sites, form, parameter, place
from longarm_comp.core.effects.joint_term import JointTerm
from longarm_comp.core.effects.sites import moving_joints, near


@dataclass(frozen=True)
class JointGain(JointTerm):
    """A revolute joint turns ``(1 + gain) q``; its offset at q = 0 is `joint_zero`."""

    name = "joint_gain"
    title = "scale error of the joint"
    action = "Check the gear ratio and the counts per turn in the servo's settings."
    actions: ClassVar = {
        "motor": "Check the gear ratio and the encoder's counts per turn in the drive's settings.",
        "hydraulic": "Calibrate the joint's angle or length sensor again, at both ends of travel.",
        "cable": "Measure the drum's diameter with the cable on it and set the ratio.",
    }
    free_levels = 2

    gain: float = parameter("1", "extra motion per commanded motion", prior=0.05)

    def twists(self, posture: Posture) -> Twists:
        return self.motion(posture, self.gain * self.command(posture))


@dataclass(frozen=True)
class PrismaticPitch(JointGain):
    """A prismatic joint travels ``(1 + gain) q``."""

    name = "prismatic_pitch"
    title = "pitch error of the slide"
    types = ("prismatic",)
    action = "Check the pitch of the spindle or belt in the servo's settings."
    actions: ClassVar = {
        "hydraulic": "Calibrate the cylinder's length sensor again, at both ends of its travel.",
        "cable": "Measure the drum's diameter with the cable on it and set the ratio.",
    }
    free_levels = 0

    gain: float = parameter("1", "extra travel per commanded travel", prior=0.02)


@dataclass(frozen=True)
class JointCoupling(JointTerm):
    """A turning joint turns by ``coupling`` times the command of a turning joint near it.

    Rods, belts and gears that run past one joint to the next couple neighbours, or joints with one
    between them (`near`). All of a command (factor 1 or -1) is declared: `coupling` in arm.yaml.

    Attributes:
        other: row id of the joint that it counts with.
    """

    name = "joint_coupling"
    title = "coupling of two joints"
    action = "Check the rod, belt or gear that runs past one joint to the other, and its ratio."

    other: int = place(moving_joints)
    coupling: float = parameter("1", "motion per commanded motion of the other", prior=5e-3)

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        turning = [(k, row) for k, row in enumerate(arm.commanded) if cls.fits(arm, row)]
        pairs = itertools.permutations(turning, 2)
        return [{"joint": j, "other": o} for (a, j), (b, o) in pairs if near(a, b)]

    def twists(self, posture: Posture) -> Twists:
        commanded = posture.q[posture.arm.commanded.index(self.other)]
        return self.motion(posture, self.coupling * commanded)


@dataclass(frozen=True)
class GearEccentricity(JointTerm):
    """``cosine cos(order q) + sine sin(order q)``, with so many periods per turn of the joint."""

    name = "gear_eccentricity"
    title = "eccentric gear"
    action = "Seat the gear wheel or encoder disc again, or replace it."
    actions: ClassVar = {
        "hydraulic": "Check the linkage's pins and the seat of the angle sensor.",
        "cable": "Seat the drum or sheave again, or replace it.",
    }
    free_levels = 3

    order: int = form(1, tried=(1, 2))
    cosine: float = parameter("rad", "cosine amplitude", prior=2e-3)
    sine: float = parameter("rad", "sine amplitude", prior=2e-3)

    @property
    def place(self) -> str:
        """Each order of a joint on its own: real gears have several."""
        return f"{self.where}, order {self.order}"

    def twists(self, posture: Posture) -> Twists:
        angle = float(self.order) * self.command(posture)
        amount = self.cosine * spatial.cos(angle) + self.sine * spatial.sin(angle)
        return self.motion(posture, amount)


@dataclass(frozen=True)
class GuideCurvature(JointTerm):
    """Constant curvature: the slide turns by ``curvature * q`` and moves by its integral.

    These are the pitch and yaw of a linear axis in ISO 230-1, to first order in its travel.
    """

    name = "guide_curvature"
    title = "curved guide"
    types = ("prismatic",)
    action = "Align the guide rail or replace it."

    about_x: float = parameter("rad/m", "turn about x per travel", prior=5e-3)
    about_y: float = parameter("rad/m", "turn about y per travel", prior=5e-3)

    def twists(self, posture: Posture) -> Twists:
        q = self.command(posture)
        x, y = self.about_x * q, self.about_y * q
        return {posture.frame(self.joint): (0.5 * q * y, -0.5 * q * x, 0.0, x, y, 0.0)}


@dataclass(frozen=True)
class UnfinishedMove(JointTerm):
    """The joint stands short of its command by a share of its last way.

    So it does where it is measured, or used, before it has arrived: a servo that lags closes its
    distance by the same share in the same time.
    """

    name = "unfinished_move"
    title = "joint that has not arrived"
    types = ("revolute", "prismatic")
    acts = "servo"
    action = "Wait longer before measuring; raise the servo's gains."
    actions: ClassVar = {"hydraulic": "Wait longer before measuring; check pump, valve and air."}
    needs = ("approach",)
    on_request = True  # with it the palletiser's, UR5's and UR10's rows held out err more

    share: float = parameter("1", "share of the last way that is left", prior=3e-3, lower=0.0)

    @classmethod
    def candidates(cls, arm: Arm) -> list[tuple[Self, ...]]:
        """Return all joints together: who waits too shortly waits as long for every joint."""
        return [tuple(cls(joint=row) for row in cls.rows(arm))]

    def price(self, arm: Arm) -> float:
        """Return its part of what the choice among single joints and all of them costs."""
        count = len(self.rows(arm))
        return super().price(arm) + math.log(count + 1) / count

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("last_way",)

    def twists(self, posture: Posture) -> Twists:
        return self.motion(posture, -self.share * self.last_way(posture))


_STEPS_PER_TURN = (
    *(180, 200, 256, 300, 360, 400, 500, 512, 600, 720, 800, 900, 1000, 1024, 1080),
    *(1200, 1440, 1800, 2000, 2048, 3600, 4096),
)


@dataclass(frozen=True)
class ServoQuantisation(JointTerm):
    """The joint stands at the nearest step: ``round(q/step) step - q``.

    Nothing is fitted: a servo either rounds so or it does not.  (With a free amplitude a
    coarse pose grid lets it imitate any function of the joint, and it then errs off the grid.)

    Attributes:
        steps_per_turn: steps of the servo in one turn; 0: as `step_deg` or `step_m` declares. A
            listed number of steps (`_STEPS_PER_TURN`), or what a scan found (`step_scan`).
        step_m: step of a slide that declares none, m.
    """

    name = "servo_quantisation"
    title = "servo steps"
    types = ("revolute", "prismatic")
    acts = "servo"
    action = "Nothing to repair: commands keep to the steps; finer ones need another servo."
    continuous = False
    stepped = True
    free_levels = 3  # of steps of an unknown size

    steps_per_turn: float = form(1000)
    step_m: float = form(0.0)

    @classmethod
    def of_step(cls, arm: Arm, row: int, step: float) -> Self:
        """Return the instance of a step (rad or m) that nobody declared."""
        if arm.joints[row - 1].type == "prismatic":
            return cls(row, steps_per_turn=0, step_m=step)
        return cls(row, steps_per_turn=2 * math.pi / step)

    def price(self, arm: Arm) -> float:
        """Return the price of choosing this size of step among all that could be told apart.

        A listed or declared step costs nothing. Two other steps can be told apart if they differ by
        a quarter of a step at the end of the range.
        """
        if not self.step_m and self.steps_per_turn in (0, *_STEPS_PER_TURN):
            return 0.0
        number = arm.commanded.index(self.joint)
        return math.log(4.0 * float(arm.upper[number] - arm.lower[number]) / self.step(arm))

    def step(self, arm: Arm) -> float:
        if self.steps_per_turn:
            return 2 * math.pi / self.steps_per_turn
        return self.step_m or arm.joints[self.joint - 1].step

    @classmethod
    def candidates(cls, arm: Arm) -> list[tuple[Self, ...]]:
        """Return the joints without a declared step, with one kind of servo, by its steps.

        All joints, where the arm declares every step: then the model holds them already.
        """
        revolute = [row for row in arm.commanded if JointTerm.fits(arm, row)]
        rows = [row for row in revolute if arm.joints[row - 1].step == 0] or revolute
        return [
            tuple(cls(joint=row, steps_per_turn=steps) for row in rows)
            for steps in _STEPS_PER_TURN
            if rows
        ]

    @property
    def reading(self) -> str:
        if self.step_m:
            return f"steps of {1e3 * self.step_m:.4g} mm"
        if not self.steps_per_turn:
            return "in the steps that the arm declares"
        return f"{self.steps_per_turn:.6g} steps a turn, {360 / self.steps_per_turn:.3g}° each"

    def twists(self, posture: Posture) -> Twists:
        step = self.step(posture.arm)
        if not step:
            return {}
        q = self.command(posture)
        rounded = step * spatial.floor(q / step + 0.5)
        return self.motion(posture, rounded - q)
