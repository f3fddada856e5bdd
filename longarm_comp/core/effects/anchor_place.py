"""Where a point is that distances are measured to."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.effects.effect import Arm, Bias, Context, Sites, Vec, parameter, place


@dataclass(frozen=True)
class AnchorPlace(Bias):
    """A draw-wire's or distance meter's fixed point is not where it was declared.

    One that was not declared is solved from the origin, with any place equally likely.
    """

    name = "anchor_place"
    title = "anchor placement"
    action = "Measure where the anchor stands and declare it."
    geometry = True
    sees = frozenset({"distance"})

    anchor: str = place(default="")
    x: float = parameter("m", "place of the anchor", 0.05, unknown=True)
    y: float = parameter("m", "place of the anchor", 0.05, unknown=True)
    z: float = parameter("m", "place of the anchor", 0.05, unknown=True)

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        return [{"anchor": k} for k, v in arm.anchors.items() if v.xyz_m is None]

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        """The tip moved against the anchor, for the rows that measure to it."""
        mine = context.is_label("anchor", self.anchor)
        return spatial.sub(point, spatial.scale(mine, (self.x, self.y, self.z)))
