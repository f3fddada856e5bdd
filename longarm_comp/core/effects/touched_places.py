"""Places of touched points and planes, which are solved from the touches."""

import dataclasses
from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.spatial import Scalar, Vec
from longarm_comp.core.effects.effect import Bias, Parameter, form, parameter, place


@dataclass(frozen=True)
class TouchPlace(Bias):
    """A point at an unknown place that the tip touched in several rows.

    Points at a known distance from it (`touch_beside`) move with it.

    Attributes:
        touch: name of the point.
        carries: names of the points that move with it, one per line.
    """

    name = "touch_place"
    title = "touched point"
    action = "Nothing to repair: the point is solved from the touches."
    geometry = True
    passing = True
    sees = frozenset({"touch"})

    touch: str = place(default="")
    carries: str = form("")
    x: float = parameter("m", "place of the point", 0.05, unknown=True)
    y: float = parameter("m", "place of the point", 0.05, unknown=True)
    z: float = parameter("m", "place of the point", 0.05, unknown=True)

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        """Return the tip less the point, m, in rows that touched it or a point that it carries."""
        mine = rows_that_touched(context, self.touch, self.carries)
        return spatial.sub(point, spatial.scale(mine, (self.x, self.y, self.z)))


def rows_that_touched(context: Context, name: str, carries: str) -> Scalar:
    """Return 1 in rows that touched a point or one that it carries (one name a line), else 0."""
    mine = context.is_label("touch", name)
    for further in carries.splitlines():
        mine = mine + context.is_label("touch", further)
    return mine


@dataclass(frozen=True)
class TouchBeside(Bias):
    """A touched point at a known distance from another one, in an unknown direction.

    The direction is the x axis rotated by the rotation vector (rx, ry, rz). These are three numbers
    for two unknowns, so no direction is singular. The distance may be wrong within its tolerance.

    Attributes:
        touch: name of the point.
        distance: known distance from the other point, m.
        tolerance: standard deviation of this distance, m.
        carries: names of the points that move with it, one per line.
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
        """Return the tip less the way from the other point, m, as `TouchPlace` does."""
        turn = spatial.exp_large((0.0, 0.0, 0.0, self.rx, self.ry, self.rz))
        way = spatial.scale(self.distance + self.stretch, turn.rotate((1.0, 0.0, 0.0)))
        mine = rows_that_touched(context, self.touch, self.carries)
        return spatial.sub(point, spatial.scale(mine, way))


@dataclass(frozen=True)
class PlanePlace(Bias):
    """A plane at an unknown place that the tip touched in several rows: a floor, a table, a wall.

    The rotation (rx, ry, 0) turns its normal to the z axis.  Of the two opposite normals it is the
    one closer to z.
    """

    name = "plane_place"
    title = "touched plane"
    action = "Nothing to repair: the plane is solved from the touches."
    geometry = True
    passing = True
    sees = frozenset({"plane"})

    plane: str = place(default="")
    z: float = parameter("m", "height of the plane along its normal", 0.05, unknown=True)
    rx: float = parameter("rad", "turn of the plane", 0.05, unknown=True)
    ry: float = parameter("rad", "turn of the plane", 0.05, unknown=True)

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        """Return the tip in the plane's axes, m, in rows that touched it: z is its height above."""
        mine = context.is_label("plane", self.plane)
        turn = spatial.exp_large((0.0, 0.0, 0.0, mine * self.rx, mine * self.ry, 0.0))  # type: ignore[arg-type]
        x, y, z = turn.transform(point)
        return (x, y, z - mine * self.z)
