"""Where the marker sits on the last link."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from longarm_comp.core.arm.measuring import three
from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.effects.effect import Arm, Effect, Parameter, Sites, parameter, place
from longarm_comp.core.effects.sites import markers


@dataclass(frozen=True)
class TipOffset(Effect):
    """Position error of the tip (of one marker, where a session has several) in its frame.

    The tip may be anywhere in its frame, unless arm.yaml gives a tolerance.
    """

    name = "tip_offset"
    title = "marker offset"
    action = "Check the mount of the marker or tool."
    geometry = True

    marker: str = place(markers, default="")
    x: float = parameter("m", "tip position error along x", prior=3e-3, unknown=True)
    y: float = parameter("m", "tip position error along y", prior=3e-3, unknown=True)
    z: float = parameter("m", "tip position error along z", prior=3e-3, unknown=True)

    @property
    def where(self) -> str:
        return f"marker {self.marker}" if self.marker else "tip"

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        return [{"marker": name} for name in arm.markers or [""]]

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        tolerance = arm.tolerance
        known = tolerance.markers.get(self.marker) if self.marker else tolerance.tip
        if known is None:
            return self.declared()
        pairs = zip(self.declared(), three(known.xyz_m), strict=True)
        return tuple(dataclasses.replace(p, prior=prior, unknown=False) for p, prior in pairs)

    def twists(self, posture: Posture) -> Twists:
        """Translation in the carrying frame, of the marker alone: what hangs there stays."""
        spot = posture.spot(self.marker)
        if not self.marker:
            return {spot: (self.x, self.y, self.z, 0.0, 0.0, 0.0)}
        mine = posture.context.is_label("marker", self.marker)
        return {spot: (mine * self.x, mine * self.y, mine * self.z, 0.0, 0.0, 0.0)}
