"""Interface of a hidden effect on the true arm."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import ClassVar, Literal, TypeVar

from longarm_comp.core.arm.parts import Beam
from longarm_comp.sim.context import Array, State
from longarm_comp.sim.rods import Walker

ALPHA, A, THETA, D = range(4)
Scaled = TypeVar("Scaled", bound="Dosed")


@dataclass(frozen=True)
class Place:
    """A section of the chain where parts may yield."""

    kind: Literal["base", "bearing", "slide", "frame"]
    """`base` (foot), `bearing` (after Rz, before Tz of the row), `slide` (where a sliding beam
    leaves the one before it), `frame` (end of the row)."""
    row: int  # row number, 0 at the base
    joint: int | None = None  # index in q of the row's motor; None where it has none
    prismatic: bool = False  # whether the row slides
    beam: Beam | None = None  # the sliding beam
    overlap: Array | None = None  # length (N,) m of its body inside the beam before it


class Dosed:
    """Something with a size, and a name from its class (``JointZero``: ``joint_zero``)."""

    name: ClassVar[str]
    doses: ClassVar[tuple[str, ...]] = ()
    """Names of the fields that set its size; by default the first field."""

    def __init_subclass__(cls) -> None:
        if "name" not in vars(cls):
            cls.name = re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()

    def scale_by(self: Scaled, dose: float) -> Scaled:
        """Return the same effect `dose` times as large."""
        return replace(self, **{f: dose * getattr(self, f) for f in self.sizes})  # type: ignore

    @property
    def sizes(self) -> tuple[str, ...]:
        """The names of the fields that set its size."""
        return self.doses or (fields(self)[0].name,)  # type: ignore[arg-type]


class HiddenEffect(Dosed):
    """An undeclared effect on the true arm. The methods of this class change nothing.

    Subclasses are frozen dataclasses and override the methods that they need.
    """

    gated: ClassVar[bool] = False
    of_command: ClassVar[bool] = False
    """Whether it acts on the command of a joint, before all effects on the joint."""

    def joints(self, q: Array, state: State) -> Array:
        """Return the joint values (N, n) after this effect, from those before it."""
        return q

    def find_rest(self, torques: Array, state: State) -> Array | float:
        """Return offsets of joints (N, n), rad or m, by their torques at rest (N, n), N m or N.

        It is used if a hidden effect of the arm is `gated`.
        """
        return 0.0

    def before(self, torques: Array, state: State) -> Array | float:
        """Return the joints' displacements (N, n), rad or m, that a motor's encoder sees."""
        return 0.0

    def rows(self, rows: Array, state: State) -> Array:
        """Return true geometry (4, R, N): alpha, a, theta offset, d of every row (without q)."""
        return rows

    def base(self, pose: Array) -> Array:
        """Return the true placement of the foot: x, y, z, roll, pitch, yaw, (6,) m and rad."""
        return pose

    def foot(self, state: State) -> Array | float:
        """Return the motion of the foot along the axes of the base frame, (3, N) m."""
        return 0.0

    def gravity(self, gravity: Array) -> Array:
        """Return the true gravity in the base frame, (3,) m/s^2."""
        return gravity

    def softness(self, beam: Beam, state: State) -> Array | float:
        """Return the factor on the beam's compliance, scalar or (N,)."""
        return 1.0

    def masses(self, state: State) -> list[tuple[int, Array | float, tuple[float, float, float]]]:
        """Return undeclared masses: frame, kg, position m."""
        return []

    def give(self, place: Place, beyond: Walker, state: State) -> Array | None:
        """Return how a place yields: rotation vector (3, B, N), rad, of everything beyond it.

        None if it does not yield. `beyond` holds the moment and the force at the place.
        """
        return None

    def push(self, place: Place, state: State) -> Sequence[tuple[Array, Array]]:
        """Return forces (3, N), N, and points where they act, (3,) or (3, N), m, in its axes."""
        return ()

    def readings(self, state: State) -> dict[str, Array]:
        """Return further session columns (N,) that such an arm would record, noise-free."""
        return {}
