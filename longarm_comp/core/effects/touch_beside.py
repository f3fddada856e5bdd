"""Where a touched point is whose distance from another one is known."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.effect import Arm, Bias, Parameter, Vec, form, parameter, place
from longarm_comp.core.effects.touch_place import touched


@dataclass(frozen=True)
class TouchBeside(Bias):
    """A touched point at a known distance from another one, in an unknown direction.

    The direction is the x axis turned by (rx, ry, rz): three numbers for two, so that no direction
    is special. The distance may be wrong within its tolerance.
    """

    name = "touch_beside"
    title = "touched point at a known distance"
    action = "Nothing to repair: the point is solved from the touches."
    geometry = True
    passing = True
    sees = frozenset({"touch"})

    touch: str = place(default="")
    distance: float = form(0.0)
    tolerance: float = form(0.0)
    carries: str = form("")
    rx: float = parameter("rad", "direction of the point", 0.05, unknown=True)
    ry: float = parameter("rad", "direction of the point", 0.05, unknown=True)
    rz: float = parameter("rad", "direction of the point", 0.05, unknown=True)
    stretch: float = parameter("m", "error of the known distance", 1e-4)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        *turn, stretch = self.declared()
        return (*turn, dataclasses.replace(stretch, prior=self.tolerance))

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        """The point, already less the other one, less the way between the two."""
        turn = spatial.exp_large((0.0, 0.0, 0.0, self.rx, self.ry, self.rz))
        way = spatial.scale(self.distance + self.stretch, turn.rotate((1.0, 0.0, 0.0)))
        mine = touched(context, self.touch, self.carries)
        return spatial.sub(point, spatial.scale(mine, way))
