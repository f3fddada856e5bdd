"""The model from encoder readings to the tip, whatever the servos made of a command.

Effects before the encoders are in the readings already, and so left out.  A driver that trims makes
the readings equal to the commands: then this is the model of the commands too.
"""

from dataclasses import dataclass, replace

from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.effects.effect import Bias, Effect, parameter
from longarm_comp.core.effects.geometry_errors import Encoder
from longarm_comp.core.effects.joint_term import JointTerm
from longarm_comp.core.model.encoders import sees
from longarm_comp.core.model.model import Model


@dataclass(frozen=True)
class _Shaft(JointTerm):
    """The position of a joint whose encoder reads the value in q: the inverse of `Encoder`.

    It has the name and parameters of that `Encoder`, so that their uncertainty applies to it.
    """

    name = Encoder.name
    searched = False
    acts = "arm"

    zero: float = parameter("rad", "reading where the joint is at 0", 4e-3)
    scale: float = parameter("1", "extra reading per motion", 0.01)

    def twists(self, posture: Posture) -> Twists:
        read = posture.q[posture.arm.commanded.index(self.joint)]
        return self.motion(posture, (read - self.zero) * (1.0 / (1.0 + self.scale)) - read)


def by_readings(model: Model) -> Model:
    """Return the model that takes encoder readings (rad, m) as q instead of commands."""
    arm = model.arm

    def follows(term: Effect | Bias) -> bool:
        return not any(sees(arm, row, term) for row in arm.commanded)

    behind = filter(follows, model.terms)
    made = model.with_terms(
        [_Shaft(t.joint, t.zero, t.scale) if isinstance(t, Encoder) else t for t in behind]
    )
    known = model.uncertainty
    if known is None:
        return made
    others = (replace(a, terms=tuple(filter(follows, a.terms))) for a in known.alternatives)
    return replace(made, uncertainty=replace(known, alternatives=tuple(others)))
