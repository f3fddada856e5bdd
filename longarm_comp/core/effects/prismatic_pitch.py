"""Pitch error of a lead screw or rack."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.effects.effect import parameter
from longarm_comp.core.effects.joint_gain import JointGain
from longarm_comp.core.effects.joint_term import by_drive


@dataclass(frozen=True)
class PrismaticPitch(JointGain):
    """A prismatic joint travels ``(1 + gain) q``."""

    name = "prismatic_pitch"
    title = "pitch error of the slide"
    types = ("prismatic",)
    action = "Check the pitch of the spindle or belt in the servo's settings."
    actions = by_drive(
        hydraulic="Calibrate the cylinder's length sensor again, at both ends of its travel.",
        cable="Measure the drum's diameter with the cable on it and set the ratio.",
    )
    free_levels = 0

    gain: float = parameter("1", "extra travel per commanded travel", prior=0.02)
