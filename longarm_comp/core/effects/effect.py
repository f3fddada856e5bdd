"""What an effect is: a small twist at a few stations, and a handful of declared parameters.

A new effect is one file with one frozen dataclass, one line in the catalogue, one
test.  Its fields made with `parameter` *are* its parameters; the fit, the files, the
report and the documentation read them from here and from nowhere else.
"""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from typing_extensions import Self

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.posture import Lumped, Posture
from longarm_comp.core.arm.spatial import Twist, Vec
from longarm_comp.core.errors import InputError


@dataclass(frozen=True)
class Parameter:
    """One number of an effect: unit, meaning, prior standard deviation and physical bounds."""

    name: str
    unit: str
    meaning: str
    prior: float  # 0 means held at its value
    lower: float = -math.inf
    upper: float = math.inf


def parameter(
    unit: str,
    meaning: str,
    prior: float,
    lower: float = -math.inf,
    upper: float = math.inf,
    default: float = 0.0,
) -> Any:
    """Declare a field of an effect as a fitted parameter."""
    meta = {"unit": unit, "meaning": meaning, "prior": prior, "lower": lower, "upper": upper}
    return dataclasses.field(default=default, metadata={"parameter": meta})


@dataclass(frozen=True)
class _Term:
    """What arm-side effects and camera-side biases share: identity, parameters, files.

    Attributes:
        name: canonical name, used in files and reports.
        needs: recorded inputs without which none of its kind can be tested.
        geometry: always fitted and never "named" by a diagnosis.
        seen_only: moves the frame that the arm is seen in, and gravity with it.
        continuous: a small motion of the joints changes it by little; no command undoes others.
        loaded: depends on the loads, so that it must be reconverged as the arm sags.
        tunable: placement fields that may have any value, with the least and the largest; the
            candidates try a few of them and the search looks between.
    """

    name: ClassVar[str]
    needs: ClassVar[tuple[str, ...]] = ()
    geometry: ClassVar[bool] = False
    seen_only: ClassVar[bool] = False
    loaded: ClassVar[bool] = False
    continuous: ClassVar[bool] = True
    tunable: ClassVar[Mapping[str, tuple[float, float]]] = {}

    @classmethod
    def declared(cls) -> tuple[Parameter, ...]:
        """The parameters of this kind of effect, in the order of its fields."""
        return tuple(
            Parameter(f.name, **f.metadata["parameter"])
            for f in dataclasses.fields(cls)
            if "parameter" in f.metadata
        )

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """The parameters of this instance; priors may come from the arm's tolerances."""
        return self.declared()

    def with_values(self, values: Mapping[str, float]) -> Self:
        """The same effect with other values of some parameters."""
        return dataclasses.replace(self, **{name: float(v) for name, v in values.items()})

    @property
    def where(self) -> str:
        """Where on the arm, in words: ``joint 2``, ``beam boom_inner``."""
        return "arm"

    @property
    def place(self) -> str:
        """What only one instance can occupy in a model: where it is, and what else may coexist."""
        return self.where

    @property
    def placement(self) -> dict[str, Any]:
        """The fields that are not parameters: they say where and in which form."""
        fields = dataclasses.fields(self)
        return {f.name: getattr(self, f.name) for f in fields if "parameter" not in f.metadata}

    @classmethod
    def candidates(cls, arm: Arm) -> list[tuple[Self, ...]]:
        """Every form that a diagnosis may try: each a group of instances fitted together."""
        return []

    @classmethod
    def for_arm(cls, arm: Arm) -> tuple[Self, ...]:
        """The instances to fit when the user declares this effect without saying where."""
        groups = cls.candidates(arm)
        seen: dict[tuple[Any, ...], Self] = {}
        for group in groups:
            for term in group:
                seen.setdefault(tuple(map(repr, term.placement.items())), term)
        return tuple(seen.values())

    @property
    def inputs(self) -> tuple[str, ...]:
        """What this instance reads of the record of circumstances: per-joint fields, columns."""
        return self.needs

    def history_joints(self, arm: Arm) -> tuple[int, ...]:
        """Commanded joints (0-based) whose history it reads."""
        return ()

    def require(self, context: Context) -> None:
        """Raise `InputError` when an input without which it cannot be tested was not recorded."""
        for name in self.needs:
            if not context.has(name):
                raise InputError(self.name, name, "missing", "a recorded column of the session")


@dataclass(frozen=True)
class Effect(_Term, ABC):
    """An arm-side cause of error."""

    @abstractmethod
    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        """Small twist ``[d; delta]`` (m, rad) by station, each in its station's axes."""

    def masses(self, posture: Posture) -> tuple[Lumped, ...]:
        """Weight that this effect adds to the arm (kg at a point of a station)."""
        return ()

    def gravity(self, gravity: Vec) -> Vec:
        """Gravity in the base frame as this effect has it (m/s^2)."""
        return gravity

    @property
    def changes_loads(self) -> bool:
        """Whether the effect acts through other effects' loads instead of by itself."""
        kind = type(self)
        return kind.masses is not Effect.masses or kind.gravity is not Effect.gravity


@dataclass(frozen=True)
class Bias(_Term, ABC):
    """A camera-side cause: it moves the *seen* point, not the arm, and is never compensated."""

    @abstractmethod
    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        """Where the camera reports a tip that is at `point` (m, base frame)."""
