"""Hidden compliances under the true load, and undeclared loads."""

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.parts import Beam
from longarm_comp.sim.context import Array, State
from longarm_comp.sim.hidden.base import HiddenEffect, Place
from longarm_comp.sim.rods import Walker


@dataclass(frozen=True)
class JointCompliance(HiddenEffect):
    """Gears wind up: a turning joint gives `compliance` (n,) rad/(N m) times its torque."""

    compliance: Array

    def give(self, place: Place, beyond: Walker, state: State) -> Array | None:
        if place.kind != "bearing" or place.joint is None or place.prismatic:
            return None
        turn = np.zeros_like(beyond.moment)
        turn[2] = self.compliance[place.joint] * beyond.moment[2]
        return turn


@dataclass(frozen=True)
class BearingTilt(HiddenEffect):
    """Bearings tilt across their axis: `compliance` (n,) rad/(N m) times the moment across."""

    compliance: Array

    def give(self, place: Place, beyond: Walker, state: State) -> Array | None:
        if place.kind != "bearing" or place.joint is None:
            return None
        turn = self.compliance[place.joint] * beyond.moment
        turn[2] = 0.0
        return turn


@dataclass(frozen=True)
class BaseCompliance(HiddenEffect):
    """The foot tilts: `compliance` (2,) rad/(N m) times the moments about x and y."""

    compliance: Array

    def give(self, place: Place, beyond: Walker, state: State) -> Array | None:
        if place.kind != "base":
            return None
        turn = np.zeros_like(beyond.moment)
        turn[:2] = np.reshape(self.compliance, (2, 1, 1)) * beyond.moment[:2]
        return turn


@dataclass(frozen=True)
class BaseSettling(HiddenEffect):
    """The foot sinks by `sink` m/h and leans by `lean` (2,) rad/h about x and y."""

    doses = ("sink", "lean")
    sink: float
    lean: Array

    def foot(self, state: State) -> Array:
        sunk = self.sink * state.t_s / 3600.0
        return np.stack([0 * sunk, 0 * sunk, sunk])

    def give(self, place: Place, beyond: Walker, state: State) -> Array | None:
        if place.kind != "base":
            return None
        turn = np.zeros_like(beyond.moment)
        turn[:2] = np.reshape(self.lean, (2, 1, 1)) * (state.t_s / 3600.0)
        return turn


@dataclass(frozen=True)
class TelescopeClearance(HiddenEffect):
    """Sliding beams tilt in their guides by clearance / overlap, rad, and as their pads compress.

    They tilt towards the load.
    """

    doses = ("clearance", "pads")
    clearance: float  # across the guide, m
    pads: float = 0.0  # compression per force of the two pads of a guide, an overlap apart, m/N

    def give(self, place: Place, beyond: Walker, state: State) -> Array | None:
        if place.kind != "slide" or place.overlap is None:
            return None
        across = beyond.moment.copy()
        along = 0 if place.beam is not None and place.beam.role == "a" else 2
        across[along] = 0.0
        size = np.sqrt(np.sum(across**2, axis=0))
        overlap = np.maximum(place.overlap, 0.01)
        pressed = self.pads * size / overlap  # by the force on each pad
        # The play is taken up at 0.02 N m
        tilt = (self.clearance * np.tanh(size / 0.02) + pressed) / overlap
        return tilt * across / np.maximum(size, 1e-12)


@dataclass(frozen=True)
class LinkStiffness(HiddenEffect):
    """The print is softer than declared: compliance times 1 + softer (by beam name)."""

    doses = ("dose",)
    softer: dict[str, float]
    dose: float = 1.0

    def softness(self, beam: Beam, state: State) -> Array | float:
        return 1 + self.dose * self.softer.get(beam.name, 0.0)


@dataclass(frozen=True)
class Creep(HiddenEffect):
    """The print yields with time under load: compliance times 1 + more (1 - exp(-t / time))."""

    more: float
    time_s: float

    def softness(self, beam: Beam, state: State) -> Array | float:
        return 1 + self.more * -np.expm1(-state.t_s / self.time_s)


@dataclass(frozen=True)
class ThermalSoftening(HiddenEffect):
    """The print softens as it warms: compliance times 1 + `rate` (T - reference), 1/K."""

    rate: float

    def softness(self, beam: Beam, state: State) -> Array | float:
        return 1 + self.rate * (state.temperature_c - state.arm.reference_temperature_c)


@dataclass(frozen=True)
class TipPayload(HiddenEffect):
    """An undeclared mass (kg) in the payload's place (the tip where none is declared)."""

    mass_kg: float

    def masses(self, state: State) -> list[tuple[int, Array | float, tuple[float, float, float]]]:
        place = state.arm.payload or state.arm.tip
        return [(place.frame, self.mass_kg, place.position_m)]


@dataclass(frozen=True)
class LinkMass(HiddenEffect):
    """An undeclared mass (kg) in the origin of the frame of row `row`."""

    doses = ("mass_kg",)
    row: int
    mass_kg: float

    def masses(self, state: State) -> list[tuple[int, Array | float, tuple[float, float, float]]]:
        return [(self.row, self.mass_kg, (0.0, 0.0, 0.0))]


@dataclass(frozen=True)
class MeasuredTilt(HiddenEffect):
    """The structure at frame `row` tilts, and an inclinometer there measures the tilt.

    The tilt, a rotation vector (x, y, 0) in that frame, sways with time and leans with the
    first joint; a session records it as `incl_<row>_x` and `incl_<row>_y`.
    """

    doses = ("sway", "lean")
    row: int
    sway: Array  # (2,) rad
    period_s: float  # of the sway
    lean: Array  # (2,) rad at the first joint's limits

    def readings(self, state: State) -> dict[str, Array]:
        arm, t = state.arm, state.t_s
        place = 2 * (state.q[:, 0] - arm.mid[0]) / (arm.upper[0] - arm.lower[0])
        turn = 2 * np.pi * t / self.period_s
        phases = (0.0, 1.3)
        return {
            f"incl_{self.row}_{axis}": s * np.sin(turn + p) + lean * place
            for axis, s, lean, p in zip("xy", self.sway, self.lean, phases, strict=True)
        }

    def give(self, place: Place, beyond: Walker, state: State) -> Array | None:
        if place.kind != "frame" or place.row != self.row:
            return None
        tilt = self.readings(state)
        turn = np.zeros_like(beyond.moment)
        turn[0], turn[1] = tilt[f"incl_{self.row}_x"], tilt[f"incl_{self.row}_y"]
        return turn
