"""A servo that can only stand on its steps."""

from __future__ import annotations

import math
from dataclasses import dataclass

from typing_extensions import Self

from longarm_comp.core.arm import spatial
from longarm_comp.core.effects.effect import Arm, Posture, Twists, form
from longarm_comp.core.effects.joint_term import JointTerm

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
    action = "Nothing to repair: declare the steps in arm.yaml; finer ones need another servo."
    continuous = False
    stepped = True
    free_levels = 3  # of steps of an unknown size

    steps_per_turn: float = form(1000)
    step_m: float = form(0.0)

    @classmethod
    def of_step(cls, arm: Arm, row: int, step: float) -> Self:
        """Of a step (rad or m) that nobody declared."""
        if arm.joints[row - 1].type == "prismatic":
            return cls(row, steps_per_turn=0, step_m=step)
        return cls(row, steps_per_turn=2 * math.pi / step)

    def price(self, arm: Arm) -> float:
        """A step that is neither declared nor listed is one of many: a quarter of a step at the
        end of the range sets two of them apart."""
        if not self.step_m and self.steps_per_turn in (0, *_STEPS_PER_TURN):
            return 0.0
        number = arm.commanded.index(self.joint)
        return math.log(4.0 * float(arm.upper[number] - arm.lower[number]) / self._step(arm))

    def _step(self, arm: Arm) -> float:
        """The step, rad or m; 0 where there is none."""
        if self.steps_per_turn:
            return 2 * math.pi / self.steps_per_turn
        return self.step_m or arm.joints[self.joint - 1].step

    @classmethod
    def as_declared(cls, arm: Arm) -> tuple[Self, ...]:
        """Of the joints whose steps the arm declares."""
        rows = [row for row in arm.commanded if arm.joints[row - 1].step > 0]
        return tuple(cls(joint=row, steps_per_turn=0) for row in rows)

    @classmethod
    def candidates(cls, arm: Arm) -> list[tuple[Self, ...]]:
        """The joints without a declared step, with one kind of servo, by its steps.

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
        step = self._step(posture.arm)
        if not step:
            return {}
        q = posture.q[posture.arm.commanded.index(self.joint)]
        rounded = step * spatial.floor(q / step + 0.5)
        return self.motion(posture, rounded - q)
