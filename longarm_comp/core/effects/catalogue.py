"""Every effect that a model may hold, by its canonical name: one line each, and those of others.

Another package brings effects by entry points of the group `GROUP`, each named as its effect and
pointing at its class; a file brings them where a user names it (`load_file`), which executes it.
A model.yaml names effects only, never code.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import inspect
import re
import sys
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TypeVar

from longarm_comp.core.effects.backlash import Backlash
from longarm_comp.core.effects.base_compliance import BaseCompliance
from longarm_comp.core.effects.base_pose import BasePose
from longarm_comp.core.effects.bearing_tilt import BearingTilt
from longarm_comp.core.effects.camera_drift import CameraDrift
from longarm_comp.core.effects.camera_pose import CameraPose
from longarm_comp.core.effects.camera_radial import CameraRadial
from longarm_comp.core.effects.camera_scale import CameraScale
from longarm_comp.core.effects.creep import Creep
from longarm_comp.core.effects.dh_error import DhError
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.friction_hysteresis import FrictionHysteresis
from longarm_comp.core.effects.gear_eccentricity import GearEccentricity
from longarm_comp.core.effects.gravity_direction import GravityDirection
from longarm_comp.core.effects.joint_compliance import JointCompliance
from longarm_comp.core.effects.joint_gain import JointGain
from longarm_comp.core.effects.joint_zero import JointZero
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.link_stiffness import LinkStiffness
from longarm_comp.core.effects.measured_tilt import MeasuredTilt
from longarm_comp.core.effects.prismatic_pitch import PrismaticPitch
from longarm_comp.core.effects.servo_droop import ServoDroop
from longarm_comp.core.effects.servo_quantisation import ServoQuantisation
from longarm_comp.core.effects.telescope_clearance import TelescopeClearance
from longarm_comp.core.effects.thermal_growth import ThermalGrowth
from longarm_comp.core.effects.tip_offset import TipOffset
from longarm_comp.core.effects.tip_payload import TipPayload
from longarm_comp.core.errors import InputError

Kind = type[Effect] | type[Bias]
K = TypeVar("K", bound=Kind)

GROUP = "longarm_comp.effects"
"""Group of the entry points by which another package brings effects."""

_OURS: tuple[Kind, ...] = (
    JointZero,
    DhError,
    BasePose,
    TipOffset,
    CameraPose,
    LinkDeflection,
    JointCompliance,
    BearingTilt,
    LinkStiffness,
    TipPayload,
    TelescopeClearance,
    BaseCompliance,
    MeasuredTilt,
    GravityDirection,
    Backlash,
    FrictionHysteresis,
    GearEccentricity,
    JointGain,
    PrismaticPitch,
    ServoDroop,
    ServoQuantisation,
    ThermalGrowth,
    Creep,
    CameraScale,
    CameraRadial,
    CameraDrift,
)
BUILT_IN: dict[str, Kind] = {kind.name: kind for kind in _OURS}
"""The effects of this package, in the order in which they are listed and tried."""
LIBRARY: tuple[Kind, ...] = tuple(k for k in _OURS if k.searched and not k.geometry)
"""Those of this package that a diagnosis tries: what studies and benchmarks go by."""

_STORED = (int, float, str, "int", "float", "str")
_origins: dict[str, str] = {}
_others: dict[str, Kind] = {}


def registered() -> dict[str, Kind]:
    """Every effect by name: this package's, other packages', those of files that were loaded.

    Raises:
        InputError: an entry point cannot be loaded, or is no effect.
    """
    _load_entry_points()
    return {**BUILT_IN, **_others}


def searched() -> tuple[Kind, ...]:
    """The effects that a diagnosis tries.

    Raises:
        InputError: as `registered`.
    """
    return tuple(k for k in registered().values() if k.searched and not k.geometry)


def effect_class(name: str, where: str, known_from: str = "") -> Kind:
    """The effect of a canonical name.

    Args:
        name: canonical name.
        where: names the source in the error.
        known_from: where the effect came from when the source was written (`origin`).

    Raises:
        InputError: no such effect; says what is missing.
    """
    found = BUILT_IN.get(name) or registered().get(name)
    if found is None:
        outside = f"a file (--effects FILE) or a package (entry points {GROUP})"
        allowed = f"{', '.join(sorted(registered()))}, or an effect of {outside}"
        if known_from:
            how = "a file is given with --effects, a package is installed"
            allowed = f"a registered effect; this one is defined by {known_from} ({how})"
        raise InputError(where, "effect", name, allowed)
    return found


def origin(kind: Kind) -> str:
    """Where an effect of others came from, in words; empty for one of this package."""
    return _origins.get(kind.name, "")


def register(kind: K, source: str = "") -> K:
    """Add an effect; a program that defines one may use this as a decorator.

    Args:
        kind: a frozen dataclass derived from `Effect` or `Bias`.
        source: where it comes from, in words; the class's module by default.

    Raises:
        InputError: it is no such class, a field does not say what it is, or the name is taken.
    """
    source = source or f"module {getattr(kind, '__module__', '?')}"
    _check(kind, source)
    known = BUILT_IN.get(kind.name) or _others.get(kind.name)
    if known is not None and _file(known) != _file(kind):
        taken = origin(known) or "longarm_comp"
        raise InputError(source, "name", kind.name, f"a name that {taken} does not have already")
    _others[kind.name], _origins[kind.name] = kind, source
    return kind


def load_file(path: str | Path) -> tuple[Kind, ...]:
    """Execute a Python file and add the effects that it defines; once, for the same contents.

    Raises:
        InputError: no such file, it fails, it defines no effect, or one is not as it must be.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(path, "effects", "missing", "a Python file that defines effects")
    text = path.read_bytes()
    name = f"longarm_effects_{hashlib.sha256(bytes(path.resolve()) + text).hexdigest()[:16]}"
    module = sys.modules.get(name)
    if module is None:
        spec = importlib.util.spec_from_file_location(name, path)
        if spec is None or spec.loader is None:
            raise InputError(path, "effects", path.suffix, "a Python file, .py")
        module = sys.modules[name] = importlib.util.module_from_spec(spec)
        try:
            spec.loader.exec_module(module)
        except Exception as error:
            del sys.modules[name]
            said = f"{type(error).__name__}: {error}"
            raise InputError(path, "effects", said, "a Python file that can be executed") from error
    kinds = tuple(
        value
        for value in vars(module).values()
        if _is_kind(value) and value.__module__ == name and hasattr(value, "name")
    )
    if not kinds:
        raise InputError(path, "effects", "none", "a class with a name, of Effect or Bias")
    return tuple(register(kind, f"file {path.name}") for kind in kinds)


@cache
def _load_entry_points() -> None:
    for point in sorted(entry_points(group=GROUP), key=lambda p: p.name):
        source = _source(point)
        try:
            kind = point.load()
        except Exception as error:
            said = f"{type(error).__name__}: {error}"
            raise InputError(source, "class", said, f"{point.value} that can be loaded") from error
        register(kind, source)
        if kind.name != point.name:
            raise InputError(source, "name", point.name, f"the effect's own, {kind.name}")


def _source(point: EntryPoint) -> str:
    package = f"package {point.dist.name} {point.dist.version}" if point.dist else "a package"
    return f"{package}, entry point {point.name}"


def _file(kind: Kind) -> str:
    """The file that defines a class: it may define it again, another one may not."""
    return getattr(sys.modules.get(kind.__module__), "__file__", None) or kind.__module__


def _is_kind(value: object) -> bool:
    return (
        isinstance(value, type)
        and issubclass(value, (Effect, Bias))
        and not inspect.isabstract(value)
    )


def _check(kind: Kind, source: str) -> None:
    """Whether a class is an effect that can be fitted, saved and loaded."""
    if not _is_kind(kind):
        raise InputError(source, "class", repr(kind), "a class of Effect or Bias, nothing abstract")
    name = getattr(kind, "name", "")
    if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise InputError(source, f"{kind.__name__}.name", name, "lower case, digits, underscores")
    frozen = "__dataclass_params__" in vars(kind) and vars(kind)["__dataclass_params__"].frozen
    if not frozen:
        raise InputError(source, name, kind.__name__, "a frozen dataclass, @dataclass(frozen=True)")
    for missing in kind.undeclared():
        raise InputError(
            source, f"{name}.{missing}", "undeclared", "place(), form() or parameter()"
        )
    for field in dataclasses.fields(kind):
        where = f"{name}.{field.name}"
        if hasattr(Effect, field.name) or hasattr(Bias, field.name):
            raise InputError(source, where, "taken", "a name that no effect has otherwise")
        if field.type not in _STORED:
            raise InputError(source, where, field.type, "int, float or str: what model.yaml holds")
