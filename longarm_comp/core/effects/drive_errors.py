"""Errors of a joint's motion per command: ratio, pitch, eccentric parts, guides, servos."""

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
    """A revolute joint turns in addition by ``coupling`` times the command of another one near it.

    Rods, belts and gears that run past one joint to the next couple neighbours, or joints with one
    between them (`near`). A coupling by design (factor 1 or -1) is declared as `coupling` in
    arm.yaml.

    Attributes:
        other: row id of the joint whose command is added.
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
    """A joint is off by ``cosine cos(order q) + sine sin(order q)``: `order` periods per turn."""

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
        """Joint and order: a model may hold several orders of a joint, as real gears have them."""
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
    """The joint stands short of its command by a fraction of its last motion.

    This happens if it is measured, or used, before it has arrived: a servo that lags reduces the
    distance to its command by the same fraction in the same time.
    """

    name = "unfinished_move"
    title = "joint that has not arrived"
    types = ("revolute", "prismatic")
    acts = "servo"
    action = "Wait longer before measuring; raise the servo's gains."
    actions: ClassVar = {"hydraulic": "Wait longer before measuring; check pump, valve and air."}
    needs = ("approach",)
    on_request = True  # it increases the held-out errors of the palletiser, UR5 and UR10

    share: float = parameter("1", "share of the last way that is left", prior=3e-3, lower=0.0)

    @classmethod
    def candidates(cls, arm: Arm) -> list[tuple[Self, ...]]:
        """Return all joints as one candidate: too short a wait is the same for every joint."""
        return [tuple(cls(joint=row) for row in cls.rows(arm))]

    def price(self, arm: Arm) -> float:
        """Return this joint's part of the price of the choice: any single joint, or all joints."""
        count = len(self.rows(arm))
        return math.log(count + 1) / count

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
    """The joint stands at the nearest step, so it is off by ``round(q/step) step - q``.

    Nothing is fitted: a servo either rounds in this way or it does not.  (With a free amplitude
    and a coarse grid of poses it could imitate any function of the joint, and then be wrong off the
    grid.)

    Attributes:
        steps_per_turn: steps of the servo in one turn: a usual number (`_STEPS_PER_TURN`), or the
            result of a scan (`step_scan`). 0: the step is `step_m`, or as arm.yaml declares.
        step_m: step of a slide without a declared step, m.
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
        """Return the instance with a step (rad or m) that is not declared, at a joint's row."""
        if arm.joints[row - 1].type == "prismatic":
            return cls(row, steps_per_turn=0, step_m=step)
        return cls(row, steps_per_turn=2 * math.pi / step)

    def price(self, arm: Arm) -> float:
        """Return the log of the number of distinguishable step sizes; 0: a usual or declared step.

        Two sizes are distinguishable if they differ by a quarter of a step at the end of the range.
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
        """Return one candidate for each usual number of steps per turn.

        Each holds all revolute joints without a declared step. If all steps are declared, it holds
        all revolute joints; the model has their declared steps already.
        """
        revolute = [row for row in arm.commanded if JointTerm.fits(arm, row)]
        rows = [row for row in revolute if arm.joints[row - 1].step == 0] or revolute
        usual = _STEPS_PER_TURN if rows else ()
        return [tuple(cls(row, steps_per_turn=steps) for row in rows) for steps in usual]

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
