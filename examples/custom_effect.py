"""An effect that longarm_comp does not have: a cable that pulls a joint along with another one.

longarm diagnose arm.yaml samples.csv --effects examples/custom_effect.py -o diagnosis

docs/add_an_effect.md explains this file.
"""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.effects.effect import Arm, Posture, Twists, moving_joints, parameter, place
from longarm_comp.core.effects.joint_term import JointTerm


@dataclass(frozen=True)
class CableCoupling(JointTerm):
    """A joint turns by ``gain`` times another joint's angle: its cable runs over that one's axis.

    Attributes:
        driver: row id of the joint that the cable runs over; `joint` is the one that is pulled.
    """

    name = "cable_coupling"
    title = "cable that pulls a joint"
    action = "Guide the cable through the axis of the joint that it runs over."

    driver: int = place(moving_joints)
    gain: float = parameter("1", "motion per motion of the driver", prior=0.02)

    @classmethod
    def candidates(cls, arm: Arm) -> list[tuple[CableCoupling, ...]]:
        """Every turning joint with every turning joint before it."""
        rows = cls.rows(arm)
        return [(cls(joint=j, driver=d),) for j in rows for d in rows if d < j]

    def twists(self, posture: Posture) -> Twists:
        """The pulled joint's rotation about its own axis."""
        angle = posture.q[posture.arm.commanded.index(self.driver)]
        return self.motion(posture, self.gain * angle)
