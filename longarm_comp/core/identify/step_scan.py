"""Steps of an unknown size: every step of every joint that the data could show, at once.

A servo that stands at whole steps errs by ``round(q/step) step - q``.  At a joint's poses this is a
saw-tooth with no parameter but the step, so thousands of steps are scored by one product with the
residual.  What is found must pay for the looking (`Effect.price`).  It must also explain
more than chance would of a residual that still holds something else, whose size stands for noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.joint_zero import JointZero
from longarm_comp.core.identify.candidates import Candidate
from longarm_comp.core.identify.evidence import FitColumns, FitMarginal
from longarm_comp.core.identify.model_fit import ModelFit, priors
from longarm_comp.core.model.model import slots_of

COARSEST = 12
"""Steps in a joint's range, at least: coarser ones are any function of it."""
FINEST = 1000
"""Steps in a joint's range, at most. Finer ones of usual servos are candidates by themselves."""
POSITIONS = 20
"""Positions at which a joint must have stood: on fewer levels a step imitates other functions."""
APART = 0.25
"""Steps in the range between two that are tried: at the range's end they differ by so much of a
step."""
FINER = 20
"""Steps tried between two neighbours, around the best."""
ROWS = 400
"""Rows that the first look is at, most."""
BEST = 8
"""Steps of each joint that are looked at closely."""
LIKE = 0.8
"""Correlation from which on two saw-teeth are the same step, seen twice."""
CLOSE = 3.0
"""Log evidence within which the data do not distinguish two steps."""
MUCH = 0.3
"""Share of the squares left, noise too, from which on a step is said to be unknown: many steps
follow a little of anything."""
SAID = 3
"""Steps that are said, most, where several are likely."""


@dataclass(frozen=True)
class UnknownStep:
    """Steps that show, but not their size.

    Attributes:
        name: of the effect. where: the joint. why: for people, with the likely sizes.
    """

    name: str
    where: str
    why: str


@dataclass(frozen=True)
class StepScan:
    """What the data say of unknown steps.

    Attributes:
        found: one candidate a joint, where one step stands out.
        unknown: joints with steps whose size cannot be told.
    """

    found: tuple[Candidate, ...]
    unknown: tuple[UnknownStep, ...]


def scan(fitted: ModelFit, columns: FitColumns, kind: type[Effect], need: float) -> StepScan:
    """Look for steps at every joint that declares none and has none in the model.

    Args:
        fitted: geometry, and what was found so far.
        columns: of candidates at its rows.
        kind: the effect (`Effect.of_step`).
        need: log evidence that a step must have, its own price paid.
    """
    arm, marginal = fitted.model.arm, FitMarginal(fitted)
    have = {joint for t in fitted.model.effects if isinstance(t, kind) for joint in t.joints}
    rows = [row for row in arm.commanded if row not in have]
    motions = [JointZero(row) for row in rows]
    moved = columns.of(motions) / priors(slots_of(arm, motions))
    found, unknown = [], []
    for row, column in zip(rows, np.moveaxis(moved, -1, 0), strict=True):
        joint = _Joint(fitted, marginal, kind, row, column)
        terms, share = joint.best(need)
        if len(terms) == 1 and joint.off_levels:
            found.append(Candidate(kind.name, (terms[0],), scanned=True))
        elif terms and share > MUCH:
            sizes = " or ".join(t.reading for t in terms[:SAID])
            more = " or others" if len(terms) > SAID else ""
            where = terms[0].where
            few = "" if joint.off_levels else f", which stood at {joint.positions} positions only"
            why = f"step unknown at {where}{few}: {sizes}{more} would fit"
            unknown.append(UnknownStep(kind.name, where, why))
    return StepScan(tuple(found), tuple(unknown))


@dataclass(frozen=True)
class _Joint:
    """One joint: its row, and the (N, d) motion of what is measured for a unit of it."""

    fitted: ModelFit
    marginal: FitMarginal
    kind: type[Effect]
    row: int
    column: np.ndarray

    @cached_property
    def share(self) -> np.ndarray:
        """(M,) where the joint stood at the inliers, in units of its range there."""
        arm = self.fitted.model.arm
        q = self.fitted.session.q[self.fitted.weights > 0, arm.commanded.index(self.row)]
        return np.asarray(q / (np.ptp(q) or np.inf))

    @property
    def positions(self) -> int:
        """At how many positions it stood."""
        return len(np.unique(np.round(self.share, 6)))

    @property
    def off_levels(self) -> bool:
        """Whether these are so many that a step imitates no other function."""
        return self.positions >= POSITIONS

    def best(self, need: float) -> tuple[list[Effect], float]:
        """Steps that the data cannot tell apart, the best first; none without need.

        And what share the best takes of the squares that are left.
        """
        arm, fitted, share = self.fitted.model.arm, self.fitted, self.share
        if not share.any():
            return [], 0.0
        index = arm.commanded.index(self.row)
        span = float(np.ptp(fitted.session.q[fitted.weights > 0, index]))
        white = fitted.whitened(self.column[..., None])[:, 0].reshape(len(share), -1)
        counts = self._looked(share, white * span).tolist()
        terms = [self.kind.of_step(arm, self.row, span / count) for count in counts]
        teeth = [_teeth(share * count) * span / count for count in counts]
        judged = [self._worth(white, t) for t in teeth]
        worth = np.array([value for value, _ in judged])
        worth -= [term.price(arm) for term in terms]
        order = np.argsort(-worth)
        if worth[order[0]] < need:
            return [], 0.0
        kept: list[int] = []
        for k in order[worth[order] > worth[order[0]] - CLOSE]:
            if all(np.corrcoef(teeth[k], teeth[n])[0, 1] < LIKE for n in kept):
                kept.append(int(k))
        return [terms[k] for k in kept], judged[order[0]][1]

    def _looked(self, share: np.ndarray, white: np.ndarray) -> np.ndarray:
        """Numbers of steps in the range, the best ones, by evidence apart from the geometry's.

        Args:
            share: (M,) positions in units of the range.
            white: (M, d) motion for the whole range, in units of the noise.
        """
        some = np.unique(np.linspace(0, len(share) - 1, min(ROWS, len(share))).astype(int))
        along = (white * self.marginal.py.reshape(white.shape)).sum(1)[some]
        size = 0.5 * (white**2).sum(1)[some]
        share = share[some]

        def gain(counts: np.ndarray) -> np.ndarray:
            made = []
            for part in np.array_split(counts, max(len(counts) // 256, 1)):
                teeth = _teeth(share[:, None] * part)
                made.append((along @ teeth - (size @ teeth**2) / part) / part)
            return np.concatenate(made)

        counts = np.arange(COARSEST, FINEST, APART)
        gains = gain(counts)
        inner = gains[1:-1]
        peaks = 1 + np.flatnonzero((inner >= gains[:-2]) & (inner >= gains[2:]))
        first = counts[peaks[np.argsort(-gains[peaks])[:BEST]]]
        fine = APART * np.arange(1 - FINER, FINER) / FINER
        near = first[:, None] + fine
        best = gain(near.reshape(-1)).reshape(near.shape).argmax(axis=1)
        return np.asarray(near[np.arange(len(near)), best])

    def _worth(self, white: np.ndarray, teeth: np.ndarray) -> tuple[float, float]:
        """Log evidence of one saw-tooth, and the share that it takes of the squares that are left.

        The least of three: by the noise; by all that is left, of unknown size; and by the sum over
        the rows against its scatter were the signs of the rows chance, as what is left may be large
        at some poses.
        """
        y = self.marginal.y
        shift = (white * teeth[:, None]).reshape(-1)
        projected = self.marginal.project(shift)
        gain = float(projected @ y - 0.5 * projected @ shift)
        left = float(self.marginal.py @ self.marginal.py)
        free = max(len(y) - self.fitted.effective, 1.0)
        ratio = max(1.0 - 2.0 * gain / left, 1e-12)
        rows = (shift * self.marginal.py).reshape(white.shape).sum(1)
        signs = 0.5 * float(rows.sum() ** 2 / max((rows**2).sum(), 1e-300))
        return min(gain, -0.5 * free * float(np.log(ratio)), signs), 1.0 - ratio


def _teeth(turns: np.ndarray) -> np.ndarray:
    """What rounding adds to a number of steps, in steps."""
    return np.asarray(np.floor(turns + 0.5) - turns)
