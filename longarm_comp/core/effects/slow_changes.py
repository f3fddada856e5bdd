"""Changes with time and temperature."""

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import CLOCK, Context
from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.arm.spatial import Scalar, Twist, sum_twists
from longarm_comp.core.effects.effect import Effect, form, parameter
from longarm_comp.core.effects.link_deflection import extra_sag


def slowing() -> float:
    """Declare the form field for an exponential slowdown: one over the time constant, 1/h.

    0 means a constant rate. The upper limit and the tried values follow from usual time constants:
    a quarter of an hour or more for a warm-up, hours for ground that settles.
    """
    return form(0.0, lower=0.0, upper=36.0, tried=(0.0, 0.25, 1.0, 4.0))


def change_so_far(context: Context, slowing: float) -> Scalar:
    """Return the size of a change at the present time, over its size after the first hour.

    It is ``(1 - exp(-slowing t)) / (1 - exp(-slowing))``, or t in hours where slowing (1/h) is 0.
    """
    hours: Scalar = context.column(CLOCK, 0.0) / 3600.0
    return np.expm1(-slowing * hours) / np.expm1(-slowing) if slowing else hours


@dataclass(frozen=True)
class ThermalGrowth(Effect):
    """The lengths a and d of all rows grow by ``expansion (T - T_ref)``.

    Fixed transforms (`pose`) and the tip's offset do not grow.
    """

    name = "thermal_growth"
    title = "thermal growth"
    action = "Keep the temperature steady, or measure it while the arm works."
    needs = ("temperature_c",)

    expansion: float = parameter("1/K", "expansion coefficient of the links", prior=1e-4)

    def twists(self, posture: Posture) -> Twists:
        """Return translations along every row's a and d, in proportion to their lengths."""
        warm = posture.context.column("temperature_c", posture.arm.reference_temperature_c)
        rise = self.expansion * (warm - posture.arm.reference_temperature_c)
        growth: list[dict[int, Twist]] = []
        for joint, value in zip(posture.arm.joints, posture.values, strict=True):
            d = joint.d_m + value if joint.type == "prismatic" else joint.d_m
            growth += [
                {posture.frame(joint.id): (0.0, 0.0, rise * d, 0.0, 0.0, 0.0)},
                {posture.frame(joint.id - 1): (rise * joint.a_m, 0.0, 0.0, 0.0, 0.0, 0.0)},
            ]
        return sum_twists(growth)


@dataclass(frozen=True)
class BaseSettling(Effect):
    """The base sinks and leans with time: at a constant rate, or ever slower, as on soft ground.

    It moves the arm, so it is compensated.  A drift of the camera (`camera_drift`) looks the same
    as sinking, but can be distinguished from leaning.
    """

    name = "base_settling"
    title = "settling base"
    whole = "base"
    action = "Brace the stand; measure again after it has settled."
    needs = ("t_s",)

    slowing: float = slowing()
    sink: float = parameter("m/h", "motion along base z in the first hour", prior=1e-3)
    about_x: float = parameter("rad/h", "lean about base x in the first hour", prior=2e-3)
    about_y: float = parameter("rad/h", "lean about base y in the first hour", prior=2e-3)

    def twists(self, posture: Posture) -> Twists:
        gone = change_so_far(posture.context, self.slowing)
        sunk, x, y = self.sink * gone, self.about_x * gone, self.about_y * gone
        return {0: (0.0, 0.0, sunk, x, y, 0.0)}


@dataclass(frozen=True)
class ThermalSoftening(Effect):
    """The declared sag grows by ``softening (T - T_ref)``."""

    name = "thermal_softening"
    title = "softening by heat"
    action = "Keep the temperature steady, or measure it while the arm works."
    needs = ("temperature_c",)
    part = "links"
    loaded = True

    softening: float = parameter("1/K", "extra sag over the declared one, per kelvin", prior=0.01)

    def twists(self, posture: Posture) -> Twists:
        reference = posture.arm.reference_temperature_c
        share = self.softening * (posture.context.column("temperature_c", reference) - reference)
        return extra_sag(posture, share)


@dataclass(frozen=True)
class Creep(Effect):
    """The declared sag grows by ``amount (1 - exp(-t/time))`` (one Kelvin-Voigt element).

    t counts from the start of the session; `time` is the time constant, s.
    """

    name = "creep"
    title = "creep"
    action = "Take the load off between jobs; replace plastic parts that carry load."
    needs = ("t_s",)
    part = "links"
    loaded = True

    time: float = form(3600.0, lower=100.0, upper=1e5, tried=(900.0, 3600.0, 14400.0))
    amount: float = parameter("1", "final extra sag over the elastic one", prior=0.3, lower=0.0)

    def twists(self, posture: Posture) -> Twists:
        grown = self.amount * (1.0 - np.exp(-posture.context.column("t_s", 0.0) / self.time))
        return extra_sag(posture, grown)
