"""The record of circumstances: all that an effect may need besides the joint values.

Sessions, targets, the running arm, the solvers of the inverse kinematics and the inputs of
the predictor loop over the declared fields (`PER_JOINT`, `Layout`).  So a new field is declared
only here.  The joints' history is part of the record, so an effect is a pure function of a posture.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np

from longarm_comp.core.arm.spatial import Scalar
from longarm_comp.core.errors import InputError

INCLINATION = re.compile(r"incl_(\w+)_[xy]$")
"""Names of the columns of an inclinometer; NaN where it gave no reading."""
ORDER = "pose_number"
"""Column of the number of each pose, used where a session has no clock.

Without the column the number is infinite, because a command comes after all poses.
"""
CLOCK = "t_s"
"""Column of a session's clock, s."""
_TOLD = (CLOCK, "temperature_c", "payload_kg", ORDER)
NEVER_TOLD = "(a circumstance that no command knows)"


def is_told(name: str) -> bool:
    """Tell whether a circumstance is known for a command, from a topic or from its target."""
    return name in _TOLD or INCLINATION.match(name) is not None


def name_tilt(frame_id: str, about_x: float, about_y: float) -> dict[str, float]:
    """Return a tilt (rad) measured on a frame, as columns by name; "" and ``base`` are row 0."""
    frame = re.sub(r"\W+", "_", frame_id)
    frame = "0" if frame in ("", "base") else frame
    return {f"incl_{frame}_x": about_x, f"incl_{frame}_y": about_y}


LEGS = 7
"""Number of stored legs (displacements between reversals) of a joint.

The last one stays 0: the motion before the oldest known leg is unknown.
"""
WIDTH: Mapping[str, int] = {"approach": 1, "legs": LEGS, "last_way": 1}
"""Number of scalars per commanded joint in each history field of a `Context`."""
PER_JOINT = tuple(WIDTH)


@dataclass(frozen=True)
class Context:
    """Recorded circumstances of one posture, or of N (scalars are then (N,) arrays).

    Attributes:
        approach: per joint -1, 0 (unknown) or +1: the side it arrived from, n scalars;
            empty when unknown.
        columns: any further quantity by name: `temperature_c`, `payload_kg`, `t_s`,
            `incl_<frame>_x`, ... (SI units, temperatures in degrees Celsius).
        labels: text columns such as `group` and `marker`, one string or (N,) array of them.
        legs: per joint its last signed displacements between reversals (rad, m), the latest first,
            as `history.add_way` keeps them; n times `LEGS` scalars; 0 or empty where unknown.
        last_way: per joint the signed displacement (rad, m) since it last stood still or reversed,
            n scalars; 0 where it did not move or this is not known.
    """

    approach: tuple[Scalar, ...] = ()
    columns: Mapping[str, Scalar] = field(default_factory=dict)
    labels: Mapping[str, object] = field(default_factory=dict)
    legs: tuple[Scalar, ...] = ()
    last_way: tuple[Scalar, ...] = ()

    def has(self, name: str) -> bool:
        """Tell whether an input was recorded: a per-joint field or a column."""
        return bool(getattr(self, name)) if name in PER_JOINT else name in {ORDER, *self.columns}

    def column(self, name: str, default: float | None = None) -> Scalar:
        """Return a recorded quantity, else the default.

        Raises:
            InputError: the quantity was not recorded, and there is no default.
        """
        if name in self.columns:
            return self.columns[name]
        if name == ORDER:
            return math.inf
        if default is None:
            known = ", ".join(sorted(self.columns)) or "none"
            raise InputError("context", name, "missing", f"a recorded column (there are: {known})")
        return default

    def as_left(self, ended_s: float | None) -> Context:
        """Return the circumstances of a command: the session's clock stays at its end.

        Effects that depend on the session's clock (a base that settles) do not continue after the
        session. The pose number is dropped, so it is infinite.

        Args:
            ended_s: session clock at the end of the session, s; None if it is not known.
        """
        columns = {k: v for k, v in self.columns.items() if k not in (CLOCK, ORDER)}
        if ended_s is not None:
            columns[CLOCK] = ended_s
        elif len(columns) == len(self.columns):
            return self
        return dataclasses.replace(self, columns=columns)

    def payload_kg(self, declared: float) -> Scalar:
        """Return the recorded payload (kg), else the declared one."""
        return self.column("payload_kg", declared)

    def of_joint(self, name: str, joint: int) -> tuple[Scalar, ...]:
        """Return the scalars of a per-joint field at a commanded joint (0-based); 0: unknown."""
        width = WIDTH[name]
        values: tuple[Scalar, ...] = getattr(self, name)
        return values[width * joint : width * (joint + 1)] if values else (0.0,) * width

    def of_all(self, name: str, n: int) -> tuple[Scalar, ...]:
        """Return all scalars of a per-joint field of an arm with n joints; 0 where unknown."""
        return getattr(self, name) or (0.0,) * (n * WIDTH[name])

    def is_label(self, name: str, value: str) -> Scalar:
        """Return 1.0 where a text column holds `value`, else 0.0.

        It is 1.0 if there is no such column. The result is a scalar, or (N,) for N postures.
        """
        if name not in self.labels:
            return 1.0
        held = self.labels[name]
        if isinstance(held, str):
            return 1.0 if held == value else 0.0
        return (np.asarray(held) == value).astype(float)

    def take(self, rows: np.ndarray | slice | int) -> Context:
        """Return the context of some of N postures; a value common to all stays a scalar."""
        if not self.differs:
            return self

        def of(value: Any) -> Any:
            return np.asarray(value)[rows] if _of_each(value) else value

        history: dict[str, Any] = {k: tuple([of(v) for v in getattr(self, k)]) for k in PER_JOINT}
        columns = {name: of(v) for name, v in self.columns.items()}
        labels = {name: of(v) for name, v in self.labels.items()}
        return Context(**history, columns=columns, labels=labels)

    def each(self, count: int) -> list[Context]:
        """Return the N (`count`) contexts of N postures, each as `take` would return it.

        Raises:
            InputError: a quantity has more or fewer than N values.
        """
        if not self.differs:
            return [self] * count

        def rows(name: str, value: Any) -> list[Any]:
            if not _of_each(value):
                return [value] * count
            if len(value) != count:
                allowed = f"{count}: one of each posture"
                raise InputError("context", f"number of {name}", len(value), allowed)
            every: list[Any] = np.asarray(value).tolist()
            return every

        fields: dict[str, Iterable[Any]] = {}
        for f in dataclasses.fields(self):
            held = getattr(self, f.name)
            named = f.name not in PER_JOINT
            items = held.items() if named else ((f.name, value) for value in held)
            lists = [rows(name, value) for name, value in items]
            each = zip(*lists, strict=True) if lists else [()] * count
            fields[f.name] = [dict(zip(held, row, strict=True)) for row in each] if named else each
        made = zip(*fields.values(), strict=True)
        return [Context(**dict(zip(fields, values, strict=True))) for values in made]

    @cached_property
    def differs(self) -> bool:
        """True if any quantity has one value per posture instead of one for all."""
        history = [value for name in PER_JOINT for value in getattr(self, name)]
        every = [*history, *self.columns.values(), *self.labels.values()]
        return not {*map(type, every)} <= {float, str} and any(map(_of_each, every))

    @cached_property
    def layout(self) -> Layout:
        """The names of the numbers and texts that this record holds."""
        joints = tuple([len(getattr(self, name)) for name in PER_JOINT])
        return Layout(joints, tuple(sorted(self.columns)), tuple(sorted(self.labels.items())))


def stack_contexts(contexts: Sequence[Context]) -> Context:
    """Stack the circumstances of M postures that differ only in the history of the joints."""
    history: dict[str, Any] = {
        name: tuple(np.array([getattr(each, name) for each in contexts], dtype=float).T)
        for name in PER_JOINT
    }
    return dataclasses.replace(contexts[0], **history)


def _of_each(value: Any) -> bool:
    """Tell whether a quantity has one value per posture instead of one for all."""
    return not isinstance(value, (float, str)) and np.ndim(value) > 0


@dataclass(frozen=True)
class Layout:
    """The numbers of a `Context`, in the fixed order in which a compiled model reads them."""

    joints: tuple[int, ...]  # number of scalars of each per-joint field, in order of `PER_JOINT`
    columns: tuple[str, ...]  # sorted
    labels: tuple[tuple[str, object], ...]  # text columns, which are constants in compiled code

    @property
    def traceable(self) -> bool:
        """True if the same compiled code is valid for all rows: every text is one for all rows."""
        return all(isinstance(value, str) for _, value in self.labels)

    @property
    def count(self) -> int:
        """The number of scalars of a record: those of the per-joint fields and the columns."""
        return sum(self.joints) + len(self.columns)

    def unpack(self, values: Sequence[Any]) -> Context:
        """Return the context that holds `values`, which are `count` numbers in `pack` order."""
        ahead = iter(values)
        sizes = zip(PER_JOINT, self.joints, strict=True)
        fields: dict[str, Any] = {name: tuple(islice(ahead, count)) for name, count in sizes}
        columns = dict(zip(self.columns, ahead, strict=True))
        return Context(**fields, columns=columns, labels=dict(self.labels))

    def pack(self, context: Context, count: int) -> np.ndarray:
        """Return the numbers of a context of N (`count`) targets, or one, as (N, `self.count`)."""
        values = [value for name in PER_JOINT for value in getattr(context, name)]
        values += [context.columns[name] for name in self.columns]
        rows = np.empty((count, len(values)))
        if not context.differs:
            rows[:] = values
            return rows
        for k, value in enumerate(values):
            rows[:, k] = value
        return rows
