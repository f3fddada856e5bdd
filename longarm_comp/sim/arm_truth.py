"""The simulated real arm: declared parts, hidden effects, exact elastic rods."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.sim.context import State, TrueContext
from longarm_comp.sim.hidden.base import HiddenEffect
from longarm_comp.sim.rod_chain import Settled, Walk
from longarm_comp.sim.rods import STEPS

Array = np.ndarray


class TrueArm:
    """The true arm: the declared arm with hidden effects.

    Args:
        hidden: undeclared effects, in the order in which they act on the joints. Effects on the
            command (a servo's rounding) always come first.
        steps: integration steps per piece of rod.
        shear: include shear and extension of tubes (0.04 mm on an arm that sags by 13 mm).
    """

    def __init__(
        self,
        arm: Arm,
        hidden: Sequence[HiddenEffect] = (),
        *,
        steps: int = STEPS,
        shear: bool = False,
    ) -> None:
        if any(m.position_columns for m in arm.point_masses):
            raise InputError("simulated arm", "position_columns", "set", "masses at fixed places")
        for effect in hidden:
            if not isinstance(effect, HiddenEffect):
                raise InputError(
                    "simulated arm", "hidden", type(effect).__name__, "effects of the arm's side"
                )
        self.arm = arm
        self.hidden = tuple(sorted(hidden, key=lambda effect: not effect.of_command))
        self._steps, self._shear = steps, shear

    def tip(self, q: Array, context: TrueContext | None = None) -> Array:
        """True tip in the base frame, (N, 3) m, for commanded joints (N, n) or (n,)."""
        return self.pose(q, context)[..., :3, 3]

    def pose(self, q: Array, context: TrueContext | None = None) -> Array:
        """True tip frame in the base frame, (N, 4, 4), or (4, 4) for one posture."""
        pose = self.settled(q, context).pose
        return pose if np.ndim(q) == 2 else pose[0]

    def torques(self, q: Array, context: TrueContext | None = None) -> Array:
        """True joint loads, (N, n): N m about a turning axis, N along a sliding one."""
        return self.settled(q, context).torques

    def shafts(self, q: Array, context: TrueContext | None = None) -> Array:
        """Where the motors' encoders stand, (N, n), rad or m: what acts behind them left out."""
        state, torques = State.of(self.arm, q, context), self.torques(q, context)
        return state.q + sum((e.before(torques, state) for e in self.hidden), np.zeros(1))

    def settled(self, q: Array, context: TrueContext | None = None) -> Settled:
        state = State.of(self.arm, q, context)
        walk = Walk(state, self.hidden, self._steps, self._shear)
        gamma = walk.solve(walk.rigid())
        if any(effect.gated for effect in self.hidden):
            torques = walk.finish(gamma).torques
            held = sum((e.held(torques, state) for e in self.hidden), np.zeros_like(state.q))
            walk = Walk(state, self.hidden, self._steps, self._shear, held)
            gamma = walk.solve(gamma)
        return walk.finish(gamma)
