"""Recorded quantities that run together: the rows do not tell which of them drives an effect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.candidates import Term

TOGETHER = 0.95
"""Two recorded quantities that correlate more than this are confounded."""


@dataclass(frozen=True)
class Pair:
    """Two quantities of which an effect reads one.

    Attributes:
        names: of the quantities; `q1` is the first commanded joint.
        correlation: over the rows.
    """

    names: tuple[str, str]
    correlation: float

    @property
    def sentence(self) -> str:
        """That they run together, and what to do."""
        one, two = self.names
        return (
            f"{one} and {two} run together in these rows (correlation {self.correlation:.2f}): "
            "measure poses in random order, or at other times"
        )


def confounded(rows: Session, arm: Arm, terms: Sequence[Term]) -> list[Pair]:
    """What runs together with the joints and the columns that an effect depends on.

    Two joints that run together are left out: their effects are candidates themselves.
    """
    joints = {f"q{k + 1}": rows.q[:, k] for k in range(arm.n)}
    varied = {name: v for name, v in {**joints, **rows.columns}.items() if np.ptp(v) > 0.0}
    moved = {j for t in terms for j in t.joints if j in arm.commanded}
    own = read_by(terms) | {f"q{arm.commanded.index(j) + 1}" for j in moved}
    made = []
    for one, two in combinations(varied, 2):
        if {one, two} & own and not {one, two} <= set(joints):
            together = float(np.corrcoef(varied[one], varied[two])[0, 1])
            if abs(together) > TOGETHER:
                made.append(Pair((one, two), together))
    return made


def read_by(terms: Sequence[Term]) -> set[str]:
    """Names of the recorded columns that terms read."""
    return {name for t in terms for name in t.inputs}


def untold(rows: Session, arm: Arm, terms: Sequence[Term]) -> tuple[str, ...]:
    """What may drive an effect instead of the recorded column that it reads.

    An effect of a column, as of time, is known by the column alone; whatever the column runs
    together with could do the same in a way that the library does not hold.
    """
    read = read_by(terms)
    pairs = [pair.names for pair in confounded(rows, arm, terms)]
    return tuple(other for a, b in pairs for mine, other in ((a, b), (b, a)) if mine in read)
