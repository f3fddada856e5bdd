"""An inclinometer's reading, taken at its word."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import Self

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.arm.spatial import Twist
from longarm_comp.core.effects.effect import Effect, frames, place
from longarm_comp.core.errors import InputError


@dataclass(frozen=True)
class MeasuredTilt(Effect):
    """Frame `frame` is tilted by what the inclinometer there reads, with gain 1.

    The gain is not fitted: where tilt is hardly excited a fitted gain extrapolated to
    23.6 mm on real data, gain 1 left 1.7 mm.

    Attributes:
        frame: row id, 0 for the base; columns ``incl_<frame>_x`` and ``_y`` (rad).
    """

    name: ClassVar[str] = "measured_tilt"

    frame: int = place(frames, default=0)

    @classmethod
    def candidates(cls, arm: Arm) -> list[tuple[Self, ...]]:
        """Every frame that may carry an inclinometer."""
        return [(cls(frame=frame),) for frame in range(len(arm.joints) + 1)]

    @property
    def inputs(self) -> tuple[str, ...]:
        """Both readings."""
        return (f"incl_{self.frame}_x", f"incl_{self.frame}_y")

    def require(self, context: Context) -> None:
        """Both readings must be recorded."""
        for column in self.inputs:
            if not context.has(column):
                raise InputError(self.name, column, "missing", "an inclinometer's reading (rad)")

    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        """The reading as a rotation of the frame."""
        x, y = (posture.context.column(name, 0.0) for name in self.inputs)
        return {posture.frame(self.frame): (0.0, 0.0, 0.0, x, y, 0.0)}
