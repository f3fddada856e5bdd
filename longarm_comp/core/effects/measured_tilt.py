"""The tilt that an inclinometer measures, as an effect."""

from dataclasses import dataclass

from typing_extensions import Self

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.measuring import Inclinometer
from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.effects.effect import Effect, Parameter, form, parameter, place
from longarm_comp.core.effects.sites import frames


@dataclass(frozen=True)
class MeasuredTilt(Effect):
    """A frame is tilted by the angles that the inclinometer on it reads.

    The gain is 1 and not fitted, unless arm.yaml declares it free.  In real data with little tilt
    the model with a fitted gain was 23.6 mm off, with gain 1 only 1.7 mm.

    Attributes:
        frame: row id of the frame, 0 for the base; columns ``incl_<frame>_x`` and ``_y`` (rad).
        sensor: name of a declared inclinometer, which replaces `frame`; columns
            ``incl_<sensor>_x`` and ``_y``.
        pivot: row id of the frame that tilts with a declared inclinometer. A diagnosis searches
            for it if arm.yaml does not declare the row.
        gain: gain of a declared inclinometer, if it is declared free.
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
        """Return a candidate for each frame, and for each possible frame of a declared sensor."""
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
