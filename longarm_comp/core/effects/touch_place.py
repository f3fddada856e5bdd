"""Where a touched point is."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.effects.effect import Arm, Bias, Context, Scalar, Vec, form, parameter, place


@dataclass(frozen=True)
class TouchPlace(Bias):
    """A point that the tip touched in several rows; nobody measured where it is.

    Points at a known distance from it (`touch_beside`) move with it.
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
        """The tip less the point, for the rows that touched it or a point that it carries."""
        mine = touched(context, self.touch, self.carries)
        return spatial.sub(point, spatial.scale(mine, (self.x, self.y, self.z)))


def touched(context: Context, name: str, carries: str) -> Scalar:
    """1 in the rows that touched a point, or one of those that it carries (a name a line)."""
    mine = context.is_label("touch", name)
    for further in carries.splitlines():
        mine = mine + context.is_label("touch", further)
    return mine
