"""The truth of a case: hidden effects of the simulator in the terms of the library."""

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.sim.hidden.drives import JointCoupling
from longarm_comp.sim.hidden.loads import LinkMass
from studies.true_camera import Hidden

Values = Mapping[tuple[str, str], float]
"""(where, parameter) -> true value (SI)."""


def _joints(field: str, parameter: str, times: float = 1.0) -> Callable[[Hidden, Arm], Values]:
    def read(effect: Hidden, arm: Arm) -> Values:
        values = getattr(effect, field)
        return {
            (f"joint {row}", parameter): times * float(values[j])
            for j, row in enumerate(arm.commanded)
            if values[j] != 0.0
        }

    return read


def _arm(**fields: str) -> Callable[[Hidden, Arm], Values]:
    def read(effect: Hidden, arm: Arm) -> Values:
        return {("arm", name): float(getattr(effect, field)) for name, field in fields.items()}

    return read


def _both(*readers: Callable[[Hidden, Arm], Values]) -> Callable[[Hidden, Arm], Values]:
    return lambda effect, arm: {k: v for read in readers for k, v in read(effect, arm).items()}


def _softness(effect: Hidden, arm: Arm) -> Values:
    softer = effect.softer  # type: ignore[union-attr]
    dose = effect.dose  # type: ignore[union-attr]
    return {(f"beam {name}", "softness"): dose * s for name, s in softer.items() if s != 0.0}


def _mass(effect: Hidden, arm: Arm) -> Values:
    assert isinstance(effect, LinkMass)
    return {(f"frame {effect.row}", "mass"): effect.mass_kg}


_READERS: dict[str, Callable[[Hidden, Arm], Values]] = {
    "joint_compliance": _joints("compliance", "compliance"),
    "bearing_tilt": _both(_joints("compliance", "about_x"), _joints("compliance", "about_y")),
    "joint_gain": _joints("gain", "gain"),
    "prismatic_pitch": _joints("gain", "gain"),
    "backlash": _joints("half", "width", 2.0),
    "friction_hysteresis": _joints("lag", "width", 2.0),
    "servo_droop": _joints("compliance", "compliance"),
    "servo_deadband": _joints("half", "width", 2.0),
    "link_stiffness": _softness,
    "tip_payload": _arm(mass="mass_kg"),
    "link_mass": _mass,
    "base_compliance": lambda e, arm: {
        ("arm", f"about_{axis}"): float(c)
        for axis, c in zip("xy", e.compliance, strict=True)  # type: ignore[union-attr]
    },
    "base_settling": _arm(sink="sink"),
    "thermal_growth": _arm(expansion="rate"),
    "thermal_softening": _arm(softening="rate"),
}


def values(effect: Hidden, arm: Arm) -> Values:
    """True values of the parameters that have the same meaning in the library; may be empty."""
    read = _READERS.get(effect.name)
    return read(effect, arm) if read is not None else {}


def places(effect: Hidden, arm: Arm) -> frozenset[str]:
    """Return places of the effect in the terms of the library; empty for the whole arm."""
    found = set()
    for field in effect.sizes:
        value = getattr(effect, field)
        if np.ndim(value) and np.shape(value)[-1] == arm.n and field != "delta":
            some: np.ndarray = np.any(np.reshape(value, (-1, arm.n)), axis=0)
            found |= {f"joint {row}" for j, row in enumerate(arm.commanded) if some[j]}
    if isinstance(effect, JointCoupling):
        before = dict(zip(arm.commanded[1:], arm.commanded, strict=False))
        found = {f"{at}, other {before[int(at.split()[1])]}" for at in found}
    if isinstance(effect, LinkMass):
        found.add(f"frame {effect.row}")
    softer = getattr(effect, "softer", {})
    found |= {f"beam {name}" for name, s in softer.items() if s}
    return frozenset(found)


def at_one_place(effect: Hidden, arm: Arm, rng: np.random.Generator) -> Hidden:
    """Put the effect at one random joint or beam of its own; one of the whole arm stays."""
    where = sorted(places(effect, arm))
    if len(where) < 2:
        return effect
    kept = str(rng.choice(where))
    changes: dict[str, object] = {}
    for field in effect.sizes:
        value = getattr(effect, field)
        if np.ndim(value) and np.shape(value)[-1] == arm.n:
            mask = np.array([f"joint {row}" == kept.split(",")[0] for row in arm.commanded])
            changes[field] = value * mask
    if hasattr(effect, "softer"):
        changes["softer"] = {b: s for b, s in effect.softer.items() if f"beam {b}" == kept}
    return dataclasses.replace(effect, **changes)  # type: ignore[type-var]


def size(effect: Hidden, arm: Arm) -> int:
    """Return the number of parameters that describe it."""
    counts = [int(np.count_nonzero(getattr(effect, field))) for field in effect.sizes]
    return max(sum(counts), len(places(effect, arm)), 1)
