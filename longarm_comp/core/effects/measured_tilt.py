"""An inclinometer's reading, taken at its word."""

from __future__ import annotations

from dataclasses import dataclass

from typing_extensions import Self

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.measuring import Inclinometer
from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.effects.effect import Effect, Parameter, form, parameter, place
from longarm_comp.core.effects.sites import frames


@dataclass(frozen=True)
class MeasuredTilt(Effect):
    """Frame `frame` is tilted by what the inclinometer there reads, with gain 1.

    The gain is not fitted unless arm.yaml says so of a sensor: where tilt is hardly excited a
    fitted gain extrapolated to 23.6 mm on real data, gain 1 left 1.7 mm.

    Attributes:
        frame: row id, 0 for the base; columns ``incl_<frame>_x`` and ``_y`` (rad).
        sensor: name of a declared inclinometer instead; columns ``incl_<sensor>_x`` and ``_y``.
        pivot: row id of the frame that a sensor of undeclared row turns; it is searched.
        gain: of a sensor whose gain is declared free.
    """

    name = "measured_tilt"
    title = "tilt that an inclinometer measures"
    action = "Brace the structure there; keep the inclinometer at work."

    frame: int = place(frames, default=0)
    sensor: str = place(default="")
    pivot: int = form(-1)
    gain: float = parameter("1", "gain of a sensor where it is free", prior=1.0, default=1.0)

    @property
    def where(self) -> str:
        return f"sensor {self.sensor}" if self.sensor else f"frame {self.frame}"

    @classmethod
    def candidates(cls, arm: Arm) -> list[tuple[Self, ...]]:
        """Return each frame that may carry one, and declared ones at all rows where they may be."""
        made: list[tuple[Self, ...]] = [(cls(frame=frame),) for frame in frames(arm)]
        for name, held in arm.sensors.items():
            if isinstance(held, Inclinometer):
                rows = frames(arm) if held.row is None else [held.row]
                made += [(cls(sensor=name, pivot=row),) for row in rows]
        return made

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        held = arm.sensors.get(self.sensor)
        free = isinstance(held, Inclinometer) and held.gain == "free"
        return self.declared() if free else ()

    @property
    def inputs(self) -> tuple[str, ...]:
        of = self.sensor or self.frame
        return (f"incl_{of}_x", f"incl_{of}_y")

    def twists(self, posture: Posture) -> Twists:
        x, y = (posture.context.column(name, 0.0) for name in self.inputs)
        held = posture.arm.sensors.get(self.sensor)
        if not isinstance(held, Inclinometer):
            return {posture.frame(self.frame): (0.0, 0.0, 0.0, x, y, 0.0)}
        gain = self.gain if held.gain == "free" else 1.0
        turn = {"x": 0.0, "y": 0.0, "z": 0.0}
        for axis, sign, reading in zip(held.axes, held.sign, (x, y), strict=True):
            turn[axis] = gain * sign * reading
        station = posture.frame(max(self.pivot, 0))
        return {station: (0.0, 0.0, 0.0, turn["x"], turn["y"], turn["z"])}
