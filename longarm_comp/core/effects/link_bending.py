"""A link that bends although no beam is declared for it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm, Joint
from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.effects.effect import Effect, Parameter, Scalar, Sites, parameter, place
from longarm_comp.core.effects.joint_term import reach, typical_loads, with_prior
from longarm_comp.core.effects.sites import rows

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
        """Every row with a length and without a declared beam."""
        declared = {beam.row for beam in arm.links}
        return [{"row": j.id} for j in arm.joints if j.id not in declared and _long(j)]

    def price(self, arm: Arm) -> float:
        """Any link may bend as likely as any other, those too whose beams are declared."""
        every = sum(map(_long, arm.joints))
        return math.log(every / len(self.sites(arm)))

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Prior: 10 mrad over a quarter of the reach under the arm's typical torque.

        A short bracket of that section turns by little, as the arm's own beams would.
        """
        return with_prior(self.declared(), prior=0.01 / (typical_loads(arm)[1] * reach(arm) / 4))

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
