"""The quantities that a discovered function may depend on, read at the rows of a session."""

from collections import defaultdict
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import ORDER, is_told
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.quantities import (
    JointPosition,
    JointSide,
    JointWay,
    OfPosture,
    Quantity,
    Recorded,
    Span,
    is_column,
    quantity,
)
from longarm_comp.core.effects.shapes import LARGEST
from longarm_comp.core.identify.model_tolerance import FORM_KNOWN_WITHIN

NEGLIGIBLE = FORM_KNOWN_WITHIN
"""Part of a range below which nothing counts. Two inputs count as one if one explains the other but
for this part, rms. A load or a direction of gravity counts if its range is larger than this part of
the widest of its kind: less may be sag or an error of declared masses and lengths, right to a few
percent."""
GRID = 7
"""Number of values of a threshold, or of a form's scale, on the first grid.  Waves are as fine:
half a period is no shorter than the distance of two of these values."""
FINE_GRID = GRID * GRID
"""Number of values on the fine grid around the best. If rows were set aside as outliers, the whole
scale of a form is searched that finely. Positions of a joint are told apart on it over its range: a
palletiser stands at few positions, some of them near each other."""
FEW_LEVELS = 3
"""With this many positions of a joint or fewer, no curve of it can be told from another."""

SEEN = "seen_"
"""Prefix of the names of the seen point's coordinates."""


@dataclass(frozen=True)
class FunctionInput:
    """One quantity at N rows.

    Attributes:
        name: name of the quantity (`core/effects/quantities.py`).
        values: (N,) its values.
        levels: number of distinct values (`count_levels`).
        circular: whether it is an angle, of which harmonics are tried.
        smooth: whether it is a coordinate of the seen point: errors of lenses have no waves or
            thresholds.
        known_to_commands: whether a command knows its value.
    """

    name: str
    values: np.ndarray
    levels: int
    circular: bool = False
    smooth: bool = False
    known_to_commands: bool = True

    @cached_property
    def low(self) -> float:
        """Smallest value in the data."""
        return float(self.values.min())

    @cached_property
    def high(self) -> float:
        """Largest value in the data."""
        return float(self.values.max())

    @property
    def domain(self) -> tuple[str, float, float]:
        """Its name, minimum and maximum: the first arguments of every shape of it."""
        return self.name, self.low, self.high

    @property
    def is_far_from_zero(self) -> bool:
        """True if its range is a `NEGLIGIBLE` part of its values, as of a date in seconds."""
        return NEGLIGIBLE * abs(self.low + self.high) / 2 > self.high - self.low

    @property
    def shows_curves(self) -> bool:
        """True if it has enough distinct values to show more than a straight line."""
        return self.levels > FEW_LEVELS


@dataclass(frozen=True)
class FunctionInputs:
    """The quantities that a discovered function may depend on, no two of them alike (`NEGLIGIBLE`).

    Attributes:
        shared: names of those that all joints share (sum of loads, time, recorded columns).
        joints: number of commanded joints; 0 on the measuring side.
    """

    all: tuple[FunctionInput, ...]
    shared: tuple[str, ...]
    joints: int

    @cached_property
    def by_name(self) -> dict[str, FunctionInput]:
        """The quantities by name."""
        return {i.name: i for i in self.all}


def read_arm_inputs(
    arm: Arm, posture: Posture, session: Session, remembering: Collection[int] = ()
) -> FunctionInputs:
    """Compute the quantities on the arm's side at the N rows of a session.

    Args:
        posture: of the arm at these rows.
        remembering: commanded joints, 0-based, whose last displacement is a quantity too, because
            an effect found there reads the joint's history.
    """
    columns = tuple(
        "warmth" if n == "temperature_c" else n for n in session.columns if is_column(n)
    )
    made: list[FunctionInput] = []
    read: list[tuple[str, Quantity, np.ndarray]] = []
    widest = defaultdict[type, float](float)
    for name in _list_names(arm, session, columns, remembering):
        found = quantity(name)
        if isinstance(found, (OfPosture, Recorded)) and found.exists(arm):
            values = np.broadcast_to(np.asarray(found.read(posture), float), (len(session),))
            widest[type(found)] = max(widest[type(found)], float(np.ptp(values)))
            read.append((name, found, values))
    for name, found, values in read:
        if np.ptp(values) >= _least_span(arm, posture, found, values, widest[type(found)]):
            _add_distinct(made, name, values, arm)
    kept = {i.name for i in made} - {ORDER}
    shared = tuple(n for n in ("sum_loads", *columns) if n in kept)
    return FunctionInputs(tuple(made), shared, arm.n)


def _least_span(
    arm: Arm, posture: Posture, found: Quantity, values: np.ndarray, widest: float
) -> float:
    """Return the span below which a quantity is left out, because it is not known well enough.

    Of the quantities of its class the one of largest span spans `widest`.
    """
    if isinstance(found, (JointPosition, JointSide, JointWay)):
        span = float(np.ptp(np.asarray(posture.q[found.joint], float)))
        return 0.0 if span >= arm.telling[found.joint] else np.inf
    if not isinstance(found, OfPosture):
        return 0.0
    largest = float(np.abs(values).max(initial=0.0))
    share = 0.0 if isinstance(found, Span) else NEGLIGIBLE * max(widest, NEGLIGIBLE * largest)
    return max(share, found.resolution)


def read_camera_inputs(points: np.ndarray, session: Session) -> FunctionInputs:
    """Return the quantities on the measuring side: seen points (N, 3), m, and recorded columns."""
    made: list[FunctionInput] = []
    for axis, values in zip("xyz", points.T, strict=True):
        _add_distinct(made, f"{SEEN}{axis}", values, None)
    for name, values in session.context().columns.items():
        if is_column(name):
            _add_distinct(made, name, np.asarray(values), None)
    return FunctionInputs(tuple(made), (), 0)


def _list_names(
    arm: Arm, session: Session, columns: tuple[str, ...], remembering: Collection[int]
) -> Iterator[str]:
    """Yield the names of all quantities to try, plainest first: of equal ones the first is kept."""
    joints = range(1, arm.n + 1)
    rows = [joint.id for joint in arm.joints]
    yield from (f"q{j}" for j in joints)
    yield from columns
    if session.approach.any():
        yield from (f"side_{j}" for j in joints)
        yield from (f"way_{j + 1}" for j in sorted(remembering))
    yield from (f"load_{j}" for j in joints)
    yield "sum_loads"
    yield from (f"moment_{row}_{axis}" for row in rows for axis in "xyz")
    yield from (f"gravity_{row}_{axis}" for row in (0, *rows) for axis in "xyz")
    yield from (f"distance_{a}_{b}" for a in (0, *rows) for b in rows if b > a + 1)


def _add_distinct(
    made: list[FunctionInput], name: str, values: np.ndarray, arm: Arm | None
) -> None:
    """Append a quantity (N,) to `made` if it varies and none in `made` is like it (`NEGLIGIBLE`).

    Args:
        arm: the arm; None for a quantity on the measuring side, which needs none.
    """
    span = float(np.ptp(values)) if np.isfinite(values).all() else 0.0
    largest = float(np.abs(values).max(initial=0.0))
    if span <= 1e-9 * max(1.0, largest) or largest > LARGEST:
        return
    centred = values - values.mean()
    for other in made:
        against = other.values - other.values.mean()
        squares = float(centred @ centred) * float(against @ against)
        if float(centred @ against) ** 2 > (1.0 - NEGLIGIBLE**2) * squares:
            return
    found = quantity(name)
    circular = arm is not None and isinstance(found, JointPosition) and found.unit(arm) == "rad"
    smooth = name.startswith(SEEN)
    known = not is_column(name) or is_told(name)
    levels = count_levels(values)
    made.append(FunctionInput(name, np.ascontiguousarray(values), levels, circular, smooth, known))


def count_levels(values: np.ndarray) -> int:
    """Return the number of values that are distinct on a `FINE_GRID` over their range."""
    span = float(np.ptp(values)) or 1.0
    return len(np.unique(np.round((FINE_GRID - 1) * (values - values.min()) / span)))
