"""Errors of a row's modified DH parameters."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.effects.effect import Arm, Effect, Parameter, parameter, place
from longarm_comp.core.effects.joint_term import reach
from longarm_comp.core.effects.sites import rows
from longarm_comp.core.errors import InputError

_MOST_OF_REACH = 0.25
"""A length that is wrong by more, as a share of the arm's reach, is of another arm: calibration
refuses rows that see the arm as far off."""


@dataclass(frozen=True)
class DhError(Effect):
    """Manufacturing and assembly errors of one row.

    ``a`` and ``alpha`` act along and about ``x_{i-1}``, ``b`` and ``beta`` along and about
    ``y_{i-1}`` (``beta`` is Hayati's parameter, which parallel axes need; ``b`` is the length of a
    link that a fixed transform lays along y), ``d`` and ``theta`` along and about ``z_i``.
    The set is redundant on purpose; priors hold it.  What is the joint's own zero
    (`joint_zero`) is held here.
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
        """Priors from the row's tolerances; the joint variable itself is held at zero."""
        joint = arm.joints[self.row - 1]
        held = joint.tolerance
        a, d = held.a_m or 1e-3, held.d_m or 1e-3
        alpha, theta = (math.radians(v) if v else 4e-3 for v in (held.alpha_deg, held.theta_deg))
        priors = {"a": a, "b": a, "alpha": alpha, "beta": alpha, "d": d, "theta": theta}
        if joint.commanded:
            priors["theta" if joint.type == "revolute" else "d"] = 0.0
        return tuple(dataclasses.replace(p, prior=priors[p.name]) for p in self.declared())

    def check(self, arm: Arm, where: str) -> None:
        """No length is wrong by a quarter of the arm's reach."""
        most = _MOST_OF_REACH * reach(arm)
        for p in self.declared():
            value = getattr(self, p.name)
            if p.unit == "m" and abs(value) > most:
                allowed = f"within +-{most:.3g} m, a quarter of the arm's reach"
                raise InputError(where, f"{self.name}.{p.name} at {self.where}", value, allowed)

    def twists(self, posture: Posture) -> Twists:
        """``[a b 0; alpha beta 0]`` in frame i-1, ``[0 0 d; 0 0 theta]`` in frame i."""
        return {
            posture.frame(self.row - 1): (self.a, self.b, 0.0, self.alpha, self.beta, 0.0),
            posture.frame(self.row): (0.0, 0.0, self.d, 0.0, 0.0, self.theta),
        }
