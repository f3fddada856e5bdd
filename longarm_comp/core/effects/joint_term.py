"""Base classes of effects at one joint: its motion, its loads, its history."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import PER_JOINT
from longarm_comp.core.arm.history import compute_play_range
from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.arm.spatial import Scalar, Twist
from longarm_comp.core.effects.effect import Drive, Effect, Sites, form, place
from longarm_comp.core.effects.sites import moving_joints
from longarm_comp.core.effects.typical_loads import typical_loads

_RESTING = 1e-6  # N m: a vertical axis carries no torque but for rounding


@dataclass(frozen=True)
class JointTerm(Effect):
    """An effect at one row's joint."""

    actions: ClassVar[Mapping[str, str]] = {}  # replace `action`, by the joint's `drive`
    types: ClassVar[tuple[str, ...]] = ("revolute",)  # that may have it, unless `fits` says which
    passive: ClassVar[bool] = False  # every movable joint may have it, even a passive one
    acts: ClassVar[Drive] = "gear"

    joint: int = place(moving_joints)  # row id

    @classmethod
    def fits(cls, arm: Arm, row: int) -> bool:
        """Tell whether the effect applies to a commanded row."""
        return arm.joints[row - 1].type in cls.types

    @classmethod
    def rows(cls, arm: Arm) -> list[int]:
        """Return the ids of the rows that may have it: all movable ones if it is `passive`."""
        return moving_joints(arm) if cls.passive else [r for r in arm.commanded if cls.fits(arm, r)]

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        return [{"joint": row} for row in cls.rows(arm)]

    def advice(self, arm: Arm) -> str:
        return self.actions.get(arm.joints[self.joint - 1].drive, self.action)

    def history_joints(self, arm: Arm) -> tuple[int, ...]:
        reads = any(name in PER_JOINT for name in self.inputs)
        return (arm.commanded.index(self.joint),) if reads else ()

    def motion(self, posture: Posture, amount: Scalar) -> Twists:
        """Return the twists that move the joint by `amount` (rad or m) about or along its z axis.

        They act at the bearings of the joint and of all rows that follow it (mimic, coupling).
        """
        twists: dict[int, Twist] = {}
        for row, weight in self.moved_rows(posture):
            moved = amount if weight == 1.0 else weight * amount
            if posture.arm.joints[row - 1].type == "prismatic":
                twists[posture.bearing(row)] = (0.0, 0.0, moved, 0.0, 0.0, 0.0)
            else:
                twists[posture.bearing(row)] = (0.0, 0.0, 0.0, 0.0, 0.0, moved)
        return twists

    def moved_rows(self, posture: Posture) -> tuple[tuple[int, float], ...]:
        """Return the rows that move with the joint, each with its motion per unit of the joint."""
        return posture.chain.coupled_rows(self.joint)

    def slides(self, arm: Arm) -> bool:
        """Tell whether its joint is a slide."""
        return arm.joints[self.joint - 1].type == "prismatic"

    def command(self, posture: Posture) -> Scalar:
        """Return the commanded position of its joint, rad or m."""
        return posture.q[posture.arm.commanded.index(self.joint)]

    def load(self, posture: Posture) -> Scalar:
        """Return gravity's load on the joint and the rows that move with it, N m or N."""
        return row_loads(posture, self.moved_rows(posture))

    def direction(self, posture: Posture) -> Scalar:
        """Return the side from which the joint arrived: -1 from above, 0 unknown, +1 from below."""
        return self._history(posture, "approach")[0]

    def last_way(self, posture: Posture) -> Scalar:
        """Return the displacement (rad, m) since it last stood still or reversed; 0: unknown."""
        return self._history(posture, "last_way")[0]

    def wound(self, posture: Posture, radius: float) -> Scalar:
        """Return the state of a play operator driven by the joint's history, from -1 to +1.

        +1 means that the joint moved up by at least the full play, twice the `radius` (rad, m).  If
        the known history does not determine the state, it is the middle of the possible range.
        """

        def compute() -> Scalar:
            low, high = compute_play_range(self._history(posture, "legs"), radius)
            return (low + high) * (0.5 / radius)

        return posture.once(("wound", self.joint, radius), compute)

    def _history(self, posture: Posture, name: str) -> tuple[Scalar, ...]:
        return posture.context.of_joint(name, posture.arm.commanded.index(self.joint))


@dataclass(frozen=True)
class RestingTerm(JointTerm):
    """An effect of a joint with play or a deadband, which rests on one side of it.

    Attributes:
        gate: threshold: the load below which friction decides the side, as a fraction of the arm's
            typical torque (`typical_loads`), or for a slide of a quarter of the arm's weight; 0:
            the load always decides. The tried values are above the load on a vertical axis whose
            base leans by a few mrad, because so small a load would decide by chance.
        blend: width of the transition from friction to load, as a fraction of the threshold.
    """

    loaded = True

    gate: float = form(0.0, lower=0.0, upper=1.0, tried=(0.01, 0.03, 0.075, 0.15, 0.3, 0.75))
    blend: float = form(1 / 6, lower=0.01, upper=0.5)

    def side(self, posture: Posture) -> Scalar:
        """Return the side on which the joint rests, from -1 to +1.

        Above the threshold the load pushes the joint to one side.  Below it, friction holds the
        joint on the side that it came from.  The transition is gradual, as under a nearly balanced
        load.
        """

        def compute() -> Scalar:
            load = self.load(posture)
            usual = typical_loads(posture.arm)
            load_there = usual.force / 4 if self.slides(posture.arm) else usual.torque
            threshold = self.gate * load_there
            settled = (abs(load) - threshold - _RESTING) / (self.blend * threshold + 0.1 * _RESTING)
            share = 0.5 + 0.5 * spatial.tanh(settled)
            return share * spatial.sign(load) - (1.0 - share) * self.direction(posture)

        return posture.once(("side", self.joint, self.gate, self.blend), compute)

    def sure_sides(self, posture: Posture) -> Mapping[int, Scalar]:
        """Return the side of arrival that is against the load, by commanded joint (0-based).

        The joint then rests on the side to which the load pushes it, for any threshold.
        """
        load = self.load(posture)
        settled = -spatial.sign(load) * (abs(load) > _RESTING)
        return {posture.arm.commanded.index(self.joint): settled}


def joint_load(posture: Posture, joint: int) -> Scalar:
    """Compute gravity's torque (N m) about a joint's z axis, or its force (N) along a slide.

    It follows from virtual work, so it includes the loads of all rows that move with the joint.
    """
    return row_loads(posture, posture.chain.coupled_rows(joint))


def row_loads(posture: Posture, rows: Iterable[tuple[int, float]]) -> Scalar:
    """Compute gravity's work per unit of a common motion, N m or N, of rows (`coupled_rows`)."""
    total: Scalar = 0.0
    for row, weight in rows:
        station = posture.bearing(row)
        sliding = posture.arm.joints[row - 1].type == "prismatic"
        share = posture.force(station)[2] if sliding else posture.moment(station)[2]
        total = total + (share if weight == 1.0 else weight * share)
    return total
