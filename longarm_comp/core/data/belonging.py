"""Do the rows belong to the arm?  What users get wrong, each tried without any declared placement.

The rigid arm is registered to the sightings (`registration`) as the rows are, and under every
mistake that is easily made.  A mistake that explains much more than the rows as they are is told,
never repaired.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.registration import Sightings, median_spread, register
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.model import Model

MIN_POSES = 20
"""Poses of which it is asked, at least: two for each unknown of a base and a marker."""
_SUSPECT_SHARE = 0.015
"""Misfit, as a share of the sightings' spread, from which on the mistakes are tried: an arm that is
not calibrated errs by less, a mistake by more."""
_TELLING_SHARE = 0.7
"""A mistake that leaves less of the misfit than this (half of its square) is told."""
_ALIKE_RATIO = 1.02
"""Mistakes whose misfits differ by less than this cannot be told apart; the first is told."""
_STRAY_RATIO, MOST_STRAYS = 8.0, 0.3
"""Rows so many times farther off than the closest quarter stray (of normal errors none does);
this share of them may: the median of the others still fits."""


@dataclass(frozen=True)
class _Belief:
    """Whether rows fit the arm, its placement apart."""

    misfit: float
    """misfit, spread: median distance (m) of the rows as they are; of the sightings from their
    middle."""
    spread: float
    stray: float  # share of the rows far beyond where the closest quarter is
    mistake: str = ""  # what explains much more of them, if anything does
    undone: float = 0.0  # median distance without that mistake, m
    signs: tuple[tuple[int, float], ...] = ()
    """Joints whose sign cannot be told, with the RMS distance (m) by which the tip moves when they
    are negated and base and tip are placed anew."""

    @property
    def belong(self) -> bool:
        """Whether the rows may be this arm's."""
        # Misfit, as a share of the sightings' spread, of rows that are not this arm's
        return not self.mistake and self.misfit < 0.25 * self.spread and self.stray < MOST_STRAYS


def believe(model: Model, session: Session) -> _Belief | None:
    """Hold the rows against the arm and, where they fit badly, against it under each mistake.

    None for fewer than `MIN_POSES` rows with a position.
    """
    seen = session.take(session.located)
    if len(np.unique(seen.pose_id)) < MIN_POSES:
        return None
    found = register(Sightings.of(model, session))
    distance = np.linalg.norm(found.residual, axis=1)
    spread = median_spread(seen.xyz)
    least = max(_STRAY_RATIO * float(np.quantile(distance, 0.25)), _SUSPECT_SHARE * spread)
    belief = _Belief(found.misfit, spread, float((distance > least).mean()))
    # Rows that the mistakes are tried on, spread over the session
    rows = np.unique(np.linspace(0, len(session) - 1, 100).astype(int))
    if found.misfit < _SUSPECT_SHARE * spread:
        signs = _signs(model, seen.take(np.unique(rows * len(seen) // len(session))), found.misfit)
        return dataclasses.replace(belief, signs=signs)
    own = register(Sightings.of(model, session.take(rows))).misfit
    tried = [
        (register(Sightings.of(model, undone.take(rows))).misfit, what, undone)
        for what, undone in mistakes(model.arm, session)
    ]
    best = min(misfit for misfit, *_ in tried)
    if best > _TELLING_SHARE * own:
        return belief
    what, undone = next(
        (what, rows) for misfit, what, rows in tried if misfit <= _ALIKE_RATIO * best
    )
    misfit = register(Sightings.of(model, undone)).misfit
    return dataclasses.replace(belief, mistake=what, undone=misfit)


def _signs(model: Model, rows: Session, misfit: float) -> tuple[tuple[int, float], ...]:
    """Moving joints that the rows would fit as well negated: their turn hardly moves the tip."""
    made = dataclasses.replace(rows, xyz=model.tip(rows.q, rows.context()))
    untold = []
    for j in np.flatnonzero(np.ptp(rows.q, axis=0) > 0):
        q = rows.q.copy()
        q[:, j] *= -1
        moved = register(Sightings.of(model, dataclasses.replace(made, q=q))).residual
        size = float(np.sqrt((moved**2).sum(axis=1).mean()))
        if size < misfit:
            untold.append((int(j), size))
    return tuple(untold)


def mistakes(arm: Arm, session: Session) -> Iterator[tuple[str, Session]]:
    """Each common mistake, and the session with it undone."""
    q, xyz = session.q, session.xyz

    def joint(j: int, values: np.ndarray) -> Session:
        changed = q.copy()
        changed[:, j] = values
        return dataclasses.replace(session, q=changed)

    for rows in (1, -1, 2, -2):
        where = "later" if rows < 0 else "earlier"
        times = "one row" if abs(rows) == 1 else f"{abs(rows)} rows"
        moved = dataclasses.replace(session, xyz=np.roll(xyz, rows, axis=0))
        yield f"x, y, z look written {times} {where} than their joints", moved
    mirrored = dataclasses.replace(session, xyz=xyz * (1.0, 1.0, -1.0))
    yield "x, y, z look mirrored: two of them are swapped or one is negated", mirrored
    for j, row in enumerate(arm.commanded):
        name = f"q{j + 1} looks"
        yield f"{name} negated", joint(j, -q[:, j])
        if arm.joints[row - 1].type != "revolute":
            continue
        for text, angle in (("half a turn", np.pi), ("a quarter turn", np.pi / 2)):
            yield f"{name} offset by {text}", joint(j, q[:, j] - angle)
            yield f"{name} negated and offset by {text}", joint(j, angle - q[:, j])
        yield f"{name} offset by minus a quarter turn", joint(j, q[:, j] + np.pi / 2)
        yield f"{name} given in degrees", joint(j, np.radians(q[:, j]))
    for j, k in combinations(range(session.n), 2):
        order = np.arange(session.n)
        order[[j, k]] = k, j
        swapped = dataclasses.replace(session, q=q[:, order])
        yield f"q{j + 1} and q{k + 1} look swapped", swapped
