"""A base that settles: ground, floor or clamps yield while the arm works."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.effects.effect import Effect, Posture, Twists, parameter


@dataclass(frozen=True)
class BaseSettling(Effect):
    """The base sinks and leans at a constant rate.

    It moves the arm, so it is compensated.  A camera that drifts only seems to move it
    (`CameraDrift`): sinking alone cannot be told from that, leaning can.
    """

    name = "base_settling"
    title = "settling base"
    whole = "base"
    action = "Brace the stand; measure again after it has settled."
    needs = ("t_s",)

    sink: float = parameter("m/h", "motion along z of the base frame", prior=1e-3)
    about_x: float = parameter("rad/h", "lean about x of the base frame", prior=2e-3)
    about_y: float = parameter("rad/h", "lean about y of the base frame", prior=2e-3)

    def twists(self, posture: Posture) -> Twists:
        hours = posture.context.column("t_s", 0.0) / 3600.0
        sunk, x, y = self.sink * hours, self.about_x * hours, self.about_y * hours
        return {0: (0.0, 0.0, sunk, x, y, 0.0)}
