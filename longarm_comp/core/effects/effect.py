"""Base classes of effects: small twists at a few stations, with declared fields.

Every field of an effect is declared as a `place` (where on the arm), a `form` (which variant) or a
`parameter` (a fitted number).  The search, the fit, the files, the report and the documentation
read only these declarations and the class attributes.  An effect of another package is therefore
treated like one of this folder (docs/add_an_effect.md).  Other names that its file needs (`Arm`,
`Context`, `Posture`, `Twists`, ...) may be imported from here too.
"""

import dataclasses
import itertools
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Any, ClassVar, Literal

from typing_extensions import Self

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import PER_JOINT, Context, is_told
from longarm_comp.core.arm.measuring import Instrument
from longarm_comp.core.arm.posture import Lumped, Posture, Twists
from longarm_comp.core.arm.spatial import Frame, Scalar, Vec
from longarm_comp.core.effects.fields import (
    FORM,
    PARAMETER,
    PLACE,
    TRIED,
    Parameter,
    Places,
    metadata,
)
from longarm_comp.core.effects.fields import form as form
from longarm_comp.core.effects.fields import parameter as parameter
from longarm_comp.core.effects.fields import place as place
from longarm_comp.core.effects.sites import moving_joints
from longarm_comp.core.errors import InputError

Drive = Literal["servo", "gear", "arm"]
Sites = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class _Term:
    """The common base of arm-side effects and measuring-side biases."""

    name: ClassVar[str]  # canonical name, used in files and reports
    title: ClassVar[str] = ""  # what a mechanic calls it: ``play``
    action: ClassVar[str] = "Look for its cause at that place."  # what can be done about it
    whole: ClassVar[str] = "arm"  # text for its place if it has no place field
    part: ClassVar[str] = ""  # attribute of `Arm` that must not be empty: ``links``, ``camera``
    needs: ClassVar[tuple[str, ...]] = ()  # recorded inputs that every instance needs
    geometry: ClassVar[bool] = False  # is always fitted, and never "named" by a diagnosis
    slips: ClassVar[bool] = False  # may slip while the arm works, though it is geometry
    knocked: ClassVar[bool] = False  # a knock may change it (or the measuring device)
    passing: ClassVar[bool] = False  # belongs to one fit and is never written into model.yaml
    seen_only: ClassVar[bool] = False
    """Whether it moves the arm, and gravity with it, only in the frame of the measurements."""
    loaded: ClassVar[bool] = False  # depends on the loads: it is iterated as the arm sags
    elastic: ClassVar[bool] = False  # yields under load: a little of it everywhere is no finding
    continuous: ClassVar[bool] = True  # changes little for a small motion of the joints
    searched: ClassVar[bool] = True  # a diagnosis tries it; geometry is always fitted instead
    on_request: ClassVar[bool] = False  # a diagnosis tries it only if the user names it (`kinds`)
    through_others: ClassVar[bool] = False  # moves the tip only through other effects: not searched
    aliases: ClassVar[tuple[str, ...]] = ()
    """Effects that no measurement of the tip can distinguish from it. One of two declares it."""
    limit_aliases: ClassVar[tuple[str, ...]] = ()
    """Effects that it equals at an end of its form's scale or of a parameter's bounds.

    Studies accept either name there.
    """
    free_levels: ClassVar[int] = 0
    """For an effect that depends only on the position of one turning joint: number of positions at
    which it can take any values, together with the joint's zero.  On a grid with no more positions
    it imitates every other such function."""
    displaces_joint: ClassVar[bool] = False
    """Whether its only parameter displaces one joint. Its column is then the motion of the tip by
    any displacement of that joint, and structure is sought along it."""
    stepped: ClassVar[bool] = False  # has steps of a size that a scan finds (`of_step`)
    bends_beams: ClassVar[bool] = False  # computes the bending of the declared beams
    acts: ClassVar[Drive] = "arm"
    """Where it acts. An encoder at the motor sees effects at the ``servo``, one at the joint also
    those at the ``gear``; no encoder sees those at the ``arm``."""

    @classmethod
    def heading(cls) -> str:
        """Return the effect's title, or its name in words if it has no title."""
        return cls.title or cls.name.replace("_", " ")

    @classmethod
    @cache
    def declared(cls) -> tuple[Parameter, ...]:
        """Return the parameters of this kind of effect, in the order of its fields."""
        each = metadata(cls, PARAMETER).items()  # type: ignore[arg-type]
        return tuple(dataclasses.replace(p, name=name) for name, p in each)

    @classmethod
    @lru_cache(maxsize=1024)
    def with_prior(cls, *priors: float, **changes: Any) -> tuple[Parameter, ...]:
        """Return the declared parameters with other priors and attributes.

        Args:
            priors: standard deviations: one for all parameters, or one for each.
            changes: further attributes of `Parameter`, the same for all.
        """
        priors = priors * len(cls.declared()) if len(priors) == 1 else priors
        each = zip(cls.declared(), priors, strict=True)
        return tuple(dataclasses.replace(p, prior=prior, **changes) for p, prior in each)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the parameters of this instance; their priors may depend on the arm."""
        return self.declared()

    def with_values(self, values: Mapping[str, float]) -> Self:
        """Return a copy with other values of some parameters."""
        return dataclasses.replace(self, **{name: float(v) for name, v in values.items()})

    @classmethod
    def allowed_places(cls) -> Mapping[str, Places]:
        """Return the function of an arm that lists a place field's values, if not any text."""
        return {name: known for name, known in metadata(cls, PLACE).items() if known}  # type: ignore[arg-type]

    @classmethod
    def scales(cls) -> Mapping[str, tuple[float, float]]:
        """Return the lower and upper end of every form field with a continuous scale, by name."""
        return {name: ends for name, ends in metadata(cls, FORM).items() if ends}  # type: ignore[arg-type]

    @property
    def places(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in metadata(type(self), PLACE)}  # type: ignore[arg-type]

    @property
    def forms(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in metadata(type(self), FORM)}  # type: ignore[arg-type]

    @property
    def placement(self) -> dict[str, Any]:
        """Values of the place and form fields."""
        return {**self.places, **self.forms}

    @property
    def where(self) -> str:
        """Its places in words: ``joint 2``, ``joint 3, driver 1``; `whole` if it has none."""
        told = (f"{name} {value}" for name, value in self.places.items() if value != "")
        return ", ".join(told) or self.whole

    def advice(self, arm: Arm) -> str:
        """Return a sentence on what can be done about the effect at an arm."""
        return self.action

    @property
    def reading(self) -> str:
        """A text about this instance in addition to its parameters: a form, a formula; or ""."""
        return ""

    @property
    def place(self) -> str:
        """Text that no two instances of one effect in a model share; by default `where`."""
        return self.where

    @cached_property
    def key(self) -> tuple[str, str]:
        """Name and place of the effect. A model holds each key once, in one form."""
        return self.name, self.place

    @cached_property
    def variant(self) -> tuple[object, ...]:
        """Name, places and forms of the effect, without the values of its parameters."""
        return (self.name, *self.placement.values())

    @cached_property
    def joints(self) -> tuple[int, ...]:
        """Row ids of the joints among its places; what it explains varies with these joints."""
        kinds = self.allowed_places()
        return tuple(v for name, v in self.places.items() if kinds.get(name) is moving_joints)

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        """Return the places on an arm, each as values by place field (one `{}` if it has none).

        The list is empty if the arm lacks the `part`, or if a place may be any text: then the rows
        of a session name the places.
        """
        allowed = cls.allowed_places()
        absent = cls.part and not getattr(arm, cls.part)
        if absent or len(allowed) < len(metadata(cls, PLACE)):  # type: ignore[arg-type]
            return []
        each = itertools.product(*(places(arm) for places in allowed.values()))
        return [dict(zip(allowed, values, strict=True)) for values in each]

    @classmethod
    def candidates(cls, arm: Arm) -> list[tuple[Self, ...]]:
        """Return the groups of instances that a diagnosis fits together.

        By default each is one instance: every place of `sites` in every form that is tried.
        """
        tried = {name: values for name, values in metadata(cls, TRIED).items() if values}  # type: ignore[arg-type]
        forms = [dict(zip(tried, v, strict=True)) for v in itertools.product(*tried.values())]
        return [(cls(**site, **form),) for site in cls.sites(arm) for form in forms]

    @classmethod
    def for_arm(cls, arm: Arm) -> tuple[Self, ...]:
        """Return the instances to fit if the user names this effect without a place."""
        every = itertools.chain(*cls.candidates(arm))
        return tuple({term.variant: term for term in every}.values())

    @classmethod
    def of_step(cls, arm: Arm, row: int, step: float) -> Self:
        """Return the instance of a `stepped` effect at a joint (row id), with a step (rad, m)."""
        raise NotImplementedError(cls.name)

    def step(self, arm: Arm) -> float:
        """Return the size of the steps at which its joint can stand, rad or m; 0: no steps."""
        return 0.0

    def price(self, arm: Arm) -> float:
        """Return the log of the number of alternatives from which this instance was chosen.

        Those that `candidates` lists do not count. It is subtracted from the log prior.
        """
        return 0.0

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the circumstances that this instance reads: per-joint fields and columns."""
        return self.needs

    def history_joints(self, arm: Arm) -> tuple[int, ...]:
        """Return the commanded joints (0-based) whose history fields (`PER_JOINT`) it reads."""
        return ()

    def check(self, arm: Arm, where: str) -> None:
        """Raise `InputError` if its fields, from `where`, are not valid on an arm."""

    def missing(self, context: Context) -> str:
        """Return the name of the first column that it reads and the context lacks, or ""."""
        read = (name for name in self.inputs if name not in PER_JOINT)
        return next((name for name in read if not context.has(name)), "")

    def require(self, context: Context) -> None:
        """Raise `InputError` if an input that the effect needs was not recorded."""
        lacking = (name for name in self.needs if not context.has(name))
        if name := next(lacking, self.missing(context)):
            raise InputError(self.name, name, "missing", "a recorded column of the session")


@dataclass(frozen=True)
class Effect(_Term, ABC):
    """An arm-side cause of error."""

    @abstractmethod
    def twists(self, posture: Posture) -> Twists:
        """Return the small twist ``[d; delta]`` (m, rad) by station, each in its station's axes."""

    def outside(self, posture: Posture) -> Sequence[tuple[str, ...]]:
        """List, for each of N postures, the inputs outside the data of the effect, in words."""
        return [()] * posture.count

    def sure_sides(self, posture: Posture) -> Mapping[int, Scalar]:
        """Return the surest side of arrival (+-1; 0: either) by commanded joint (0-based)."""
        return {}

    def masses(self, posture: Posture) -> tuple[Lumped, ...]:
        """Return the masses (kg) that the effect adds to the arm, each at a point of a station."""
        return ()

    def gravity(self, gravity: Vec) -> Vec:
        """Return gravity (m/s^2, base frame) with this effect, from that without it."""
        return gravity

    def base(self, arm: Arm) -> Frame | None:
        """Return the base in the frame of the measurements, if this effect places it; else None."""
        return None

    @property
    def commandable(self) -> bool:
        """True if a command can compensate the effect: all inputs are known for a command."""
        return all(name in PER_JOINT or is_told(name) for name in self.inputs)

    @property
    def changes_loads(self) -> bool:
        """True if the effect acts through the loads on other effects instead of by a twist."""
        kind = type(self)
        return kind.masses is not Effect.masses or kind.gravity is not Effect.gravity


@dataclass(frozen=True)
class Bias(_Term, ABC):
    """A measuring-side cause. It moves the *seen* point, not the arm, and is never compensated."""

    whole: ClassVar[str] = "measuring side"
    commandable: ClassVar[bool] = False
    sees: ClassVar[frozenset[str]] = frozenset({"position", "orientation"})
    """Names of the kinds of measurement (`core/data/kinds.py`) on which it acts."""
    instruments: ClassVar[Mapping[Instrument, str]] = {}
    """The instruments (`measuring` in arm.yaml) that may have it, each with its own text for
    `action`, or "" for `action` itself. Empty: all instruments."""

    @classmethod
    def of_instrument(cls, arm: Arm) -> bool:
        """Tell whether the arm's instrument may have it; True if no instrument is declared."""
        return arm.measuring is None or not cls.instruments or arm.measuring in cls.instruments

    def advice(self, arm: Arm) -> str:
        return (arm.measuring and self.instruments.get(arm.measuring)) or self.action

    @abstractmethod
    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        """Return the point that is reported for a tip at `point`, both (3,) m in the base frame."""

    def read(self, value: Scalar, row: int) -> Scalar:
        """Return what the encoder of a row's joint reads where it should read `value` (rad, m)."""
        return value

    def seen_pose(self, tip: Frame, context: Context, arm: Arm) -> Frame:
        """Return the reported pose of a tip.

        By default its axes move with the points 10 mm around the tip. They may have other lengths
        and angles than unit vectors, because a scale error stretches them.
        """

        def axis(direction: Vec) -> Vec:
            half = spatial.scale(0.01, direction)
            ahead = self.seen(spatial.add(tip.p, half), context, arm)
            behind = self.seen(spatial.sub(tip.p, half), context, arm)
            return spatial.scale(0.5 / 0.01, spatial.sub(ahead, behind))

        return Frame(axis(tip.n), axis(tip.o), axis(tip.a), self.seen(tip.p, context, arm))
