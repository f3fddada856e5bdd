"""Where a point is that distances are measured to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.spatial import Vec
from longarm_comp.core.effects.effect import Bias, parameter, place


@dataclass(frozen=True)
class AnchorPlace(Bias):
    """A draw-wire's or distance meter's fixed point is not where it was declared.

    One that was not declared is solved from the origin, with any place equally likely.
    """

    name: ClassVar[str] = "anchor_place"
    title: ClassVar[str] = "anchor placement"
    action: ClassVar[str] = "Measure where the anchor stands and declare it."
    geometry: ClassVar[bool] = True
    sees: ClassVar[frozenset[str]] = frozenset({"distance"})

    anchor: str = place(default="")
    x: float = parameter("m", "place of the anchor", 0.05, unknown=True)
    y: float = parameter("m", "place of the anchor", 0.05, unknown=True)
    z: float = parameter("m", "place of the anchor", 0.05, unknown=True)

    @classmethod
    def sites(cls, arm: Arm) -> Sequence[Mapping[str, Any]]:
        """Every anchor whose place is not declared."""
        return [{"anchor": k} for k, v in arm.anchors.items() if v.xyz_m is None]

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        """The tip moved against the anchor, for the rows that measure to it."""
        mine = context.is_label("anchor", self.anchor)
        return spatial.sub(point, spatial.scale(mine, (self.x, self.y, self.z)))
