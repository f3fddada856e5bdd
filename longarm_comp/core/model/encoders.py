"""Predicts joint encoders: the command, and the effects between command and encoder.

A drive is a chain: servo, gear, arm (`Effect.acts`).  A motor's encoder sees what the servo does,
one at the joint what the gear does too.  An effect displaces a joint by its twist about or along
the joint's own axis, so readings need no physics of their own.
"""

from collections.abc import Iterable, Mapping, Sequence

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.posture import Chain, Twists
from longarm_comp.core.arm.spatial import Scalar
from longarm_comp.core.effects.effect import Bias, Effect

_BEFORE: Mapping[str, frozenset[str]] = {
    "motor": frozenset({"servo"}),
    "joint": frozenset({"servo", "gear"}),
}
"""By place of an encoder, the parts of the drive whose effects it sees."""

Parts = Sequence[tuple[Effect, Twists]]
"""Effects, each with its twists by station."""


def sees(arm: Arm, row: int, term: Effect | Bias) -> bool:
    """Tell whether the encoder of a commanded row sees what a term does to its joint."""
    mine = not term.joints or row in term.joints
    return isinstance(term, Effect) and mine and term.acts in _BEFORE[arm.joints[row - 1].encoder]


def tell_apart(arm: Arm, rows: Iterable[int], one: Effect | Bias, other: Effect | Bias) -> bool:
    """Tell whether readings of some rows show one of two terms and not the other."""
    return any(
        sees(arm, row, one) != sees(arm, row, other)
        for row in rows
        if row in one.joints or row in other.joints
    )


def seen(chain: Chain, parts: Parts) -> tuple[Scalar, ...]:
    """Return the displacement that each commanded joint's encoder sees, n scalars (rad, m)."""
    total: list[Scalar] = [0.0] * chain.arm.n
    for term, twists in parts:
        for k, (row, station, axis, unit) in enumerate(chain.own_axes):
            if station in twists and sees(chain.arm, row, term):
                total[k] = total[k] + twists[station][axis] * (1.0 / unit)
    return tuple(total)
