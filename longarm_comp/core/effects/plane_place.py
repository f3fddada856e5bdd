"""Where a touched plane is."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.effects.effect import Arm, Bias, Context, Vec, parameter, place


@dataclass(frozen=True)
class PlanePlace(Bias):
    """A plane that the tip touched in several rows: a floor, a table, a wall; it may be anywhere.

    Its normal is the z axis before a turn about x and y; of two opposite ones, that closer to z.
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
        """The tip in axes of the plane, in which its height is z, for the rows that touched it."""
        mine = context.is_label("plane", self.plane)
        turn = spatial.exp_large((0.0, 0.0, 0.0, mine * self.rx, mine * self.ry, 0.0))  # type: ignore[arg-type]
        x, y, z = turn.transform(point)
        return (x, y, z - mine * self.z)
