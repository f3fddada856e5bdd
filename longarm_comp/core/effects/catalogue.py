"""Catalogue of the effects by canonical name: those of this package and registered ones.

Another package registers effects by entry points of the group `GROUP`, each with the name of the
effect and its class.  A file of effects is executed when a user names it (`load_file`).  A
model.yaml holds only names of effects, never code.
"""

import dataclasses
import inspect
import re
import sys
from collections.abc import Container
from functools import cache
from pathlib import Path
from types import GenericAlias
from typing import TypeVar

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.effects.camera_errors import CameraDrift, CameraRadial, CameraScale
from longarm_comp.core.effects.compliances import (
    BaseCompliance,
    BearingTilt,
    JointCompliance,
    LinkBending,
    LinkStiffness,
    LinkTorsion,
    ServoDroop,
)
from longarm_comp.core.effects.discovered import Discovered, DiscoveredView
from longarm_comp.core.effects.drive_errors import (
    GearEccentricity,
    GuideCurvature,
    JointCoupling,
    JointGain,
    PrismaticPitch,
    ServoQuantisation,
    UnfinishedMove,
)
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.fields import FORM, PARAMETER, PLACE
from longarm_comp.core.effects.geometry_errors import CylinderPins, DhError, Encoder, JointZero
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.masses import (
    GravityDirection,
    LinkMass,
    TipPayload,
    UndeclaredDrive,
    UndeclaredWeight,
)
from longarm_comp.core.effects.measured_tilt import MeasuredTilt
from longarm_comp.core.effects.placements import (
    AnchorPlace,
    BasePose,
    CameraPose,
    SensorPlace,
    TipOffset,
    TipOrientation,
)
from longarm_comp.core.effects.plays import (
    Backlash,
    CylinderPlay,
    FrictionHysteresis,
    ServoDeadband,
    SlidePlay,
    TelescopeClearance,
)
from longarm_comp.core.effects.slow_changes import (
    BaseSettling,
    Creep,
    ThermalGrowth,
    ThermalSoftening,
)
from longarm_comp.core.effects.touched_places import PlanePlace, TouchBeside, TouchPlace
from longarm_comp.core.entry_points import check_name, execute_file, of_other_packages
from longarm_comp.core.errors import InputError

Kind = type[Effect] | type[Bias]
_K = TypeVar("_K", bound=Kind)

GROUP = "longarm_comp.effects"
"""Group of the entry points of effects from other packages."""

_OURS: tuple[Kind, ...] = (
    *(JointZero, DhError, CylinderPins, BasePose, TipOffset, TipOrientation, AnchorPlace),
    *(SensorPlace, TouchPlace, TouchBeside, PlanePlace, CameraPose, Encoder, LinkDeflection),
    *(UndeclaredWeight, UndeclaredDrive),
    *(JointCompliance, BearingTilt, LinkStiffness, LinkTorsion, TipPayload, LinkMass),
    *(TelescopeClearance, LinkBending, SlidePlay, GuideCurvature, BaseCompliance),
    *(BaseSettling, MeasuredTilt),
    *(GravityDirection, Backlash, CylinderPlay, FrictionHysteresis, GearEccentricity, JointGain),
    *(JointCoupling, PrismaticPitch, ServoDroop, ServoDeadband, ServoQuantisation, ThermalGrowth),
    *(ThermalSoftening, Creep, UnfinishedMove),
    *(CameraScale, CameraRadial, CameraDrift, Discovered, DiscoveredView),
)
BUILT_IN: dict[str, Kind] = {kind.name: kind for kind in _OURS}
"""The effects of this package, in the order of listing and search."""


def _is_tried(kind: Kind) -> bool:
    """Tell whether a diagnosis tries an effect by default."""
    return kind.searched and not kind.geometry and not kind.on_request


LIBRARY: tuple[Kind, ...] = tuple(filter(_is_tried, _OURS))
"""The effects of this package that a diagnosis tries; used by studies and benchmarks."""

_STORED = (int, float, str, "int", "float", "str")
_others: dict[str, tuple[Kind, str]] = {}
"""Effects from outside the package, each with its origin in words."""


def registered() -> dict[str, Kind]:
    """Return all effects by name: of this package, of other packages and of loaded files."""
    _load_entry_points()
    return BUILT_IN | {name: kind for name, (kind, _) in _others.items()}


def searched_effects() -> tuple[Kind, ...]:
    """Return the effects that a diagnosis tries by default."""
    return tuple(filter(_is_tried, registered().values()))


def possible_compliances(arm: Arm, held: Container[tuple[str, str]]) -> tuple[Effect, ...]:
    """List the elastic effects of this package on an arm, except those with the keys `held`."""
    kinds = (k for k in searched_effects() if issubclass(k, Effect) and k.elastic and not origin(k))
    every = (term for kind in kinds for term in kind.for_arm(arm))
    return tuple(t for t in every if t.key not in held)


def through_others(arm: Arm) -> list[Effect]:
    """List the effects of an arm that act only through other effects (`through_others`)."""
    kinds = (kind for kind in registered().values() if issubclass(kind, Effect))
    return [term for kind in kinds if kind.through_others for term in kind.for_arm(arm)]


def effect_class(name: str, where: str, known_from: str = "") -> Kind:
    """Return the class of the effect with a canonical name; InputError if there is none.

    Args:
        where: the source of the name, as the error calls it.
        known_from: the effect's `origin`, if the source states it.
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
    """Return the source of an effect from outside this package, in words; "" for one of it."""
    return _others[kind.name][1] if kind.name in _others else ""


def register(kind: _K, source: str = "") -> _K:
    """Register the class of an effect and return it, so it can be used as a decorator.

    Args:
        source: the origin of the class, in words; by default its module.

    Raises:
        InputError: the class is not a valid effect, or its name is taken.
    """
    source = source or f"module {getattr(kind, '__module__', '?')}"
    _check_kind(kind, source)
    known, taken = _others.get(kind.name) or (BUILT_IN.get(kind.name), "longarm_comp")
    if known is not None and _file(known) != _file(kind):
        raise InputError(source, "name", kind.name, f"a name that {taken} does not have already")
    _others[kind.name] = kind, source
    return kind


def load_file(path: str | Path) -> tuple[Kind, ...]:
    """Execute a Python file, once for the same contents; register and return its effects' classes.

    Raises:
        InputError: the file defines no effect, or an invalid one.
    """
    path = Path(path)
    module = execute_file(path, "effects")
    own = [kind for kind in vars(module).values() if _is_kind(kind) and hasattr(kind, "name")]
    kinds = [kind for kind in own if kind.__module__ == module.__name__]
    if not kinds:
        raise InputError(path, "effects", "none", "a class with a name, of Effect or Bias")
    return tuple(register(kind, f"file {path.name}") for kind in kinds)


@cache
def _load_entry_points() -> None:
    for name, kind, source in of_other_packages(GROUP):
        register(kind, source)
        check_name(name, kind.name, "effect", source)


def _file(kind: Kind) -> str:
    """Return the path of the file that defines a class; only this file may redefine it."""
    return getattr(sys.modules.get(kind.__module__), "__file__", None) or kind.__module__


def _is_kind(value: object) -> bool:
    if not isinstance(value, type) or isinstance(value, GenericAlias):  # list[int], Python 3.10
        return False
    return issubclass(value, (Effect, Bias)) and not inspect.isabstract(value)


def _check_kind(kind: Kind, source: str) -> None:
    """Check that a class is an effect that can be fitted, saved and loaded."""
    if not _is_kind(kind):
        raise InputError(source, "class", repr(kind), "a class of Effect or Bias, nothing abstract")
    name = getattr(kind, "name", "")
    if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise InputError(source, f"{kind.__name__}.name", name, "lower case, digits, underscores")
    frozen = "__dataclass_params__" in vars(kind) and vars(kind)["__dataclass_params__"].frozen
    if not frozen:
        raise InputError(source, name, kind.__name__, "a frozen dataclass, @dataclass(frozen=True)")
    for field in dataclasses.fields(kind):
        where = f"{name}.{field.name}"
        if {PARAMETER, PLACE, FORM}.isdisjoint(field.metadata):
            raise InputError(source, where, "undeclared", "place(), form() or parameter()")
        if hasattr(Effect, field.name) or hasattr(Bias, field.name):
            raise InputError(source, where, "taken", "a name that no effect has otherwise")
        if field.type not in _STORED:
            raise InputError(source, where, field.type, "int, float or str: what model.yaml holds")
