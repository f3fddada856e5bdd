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
from longarm_comp.core.data.registration import Sightings, register
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.model import Model

MIN_POSES = 20
"""Poses of which it is asked, at least: two for each unknown of a base and a marker."""
SUSPECT_SHARE = 0.015
"""Misfit, as a share of the sightings' spread, from which on the mistakes are tried: an arm that is
not calibrated errs by less, a mistake by more."""
TELLING_SHARE = 0.7
"""A mistake that leaves less of the misfit than this (half of its square) is told."""
ALIKE_RATIO = 1.02
"""Mistakes whose misfits differ by less than this cannot be told apart; the first is told."""
STRAY_RATIO, MOST_STRAYS = 8.0, 0.3
"""Rows so many times farther off than the closest quarter stray (of normal errors none does);
this share of them may: the median of the others still fits."""


@dataclass(frozen=True)
class _Mistake:
    """One mistake, undone."""

    what: str
    rows: Session


@dataclass(frozen=True)
class _Belief:
    """Whether rows fit the arm, its placement apart.

    Attributes:
        misfit: median distance of the rows as they are, m.
        spread: median distance of the sightings from their middle, m.
        stray: share of the rows far beyond where the closest quarter is.
        mistake: what explains much more of them, if anything does.
        undone: median distance without that mistake, m.
        signs: joints whose sign cannot be told, with the RMS distance (m) by which the tip moves
            when they are negated and base and tip are placed anew.
    """

    misfit: float
    spread: float
    stray: float
    mistake: str = ""
    undone: float = 0.0
    signs: tuple[tuple[int, float], ...] = ()

    @property
    def belong(self) -> bool:
        """Whether the rows may be this arm's."""
        # Misfit, as a share of the sightings' spread, of rows that are not this arm's
        return not self.mistake and self.misfit < 0.25 * self.spread and self.stray < MOST_STRAYS


def believe(model: Model, session: Session) -> _Belief | None:
    """Hold the rows against the arm, and against the arm under each common mistake.

    The mistakes are tried only where the rows fit badly.

    Returns:
        None for fewer than `MIN_POSES` rows with a position.
    """
    seen = session.take(session.located)
    if len(np.unique(seen.pose_id)) < MIN_POSES:
        return None
    found = register(Sightings.of(model, session))
    distance = np.linalg.norm(found.residual, axis=1)
    spread = float(np.median(np.linalg.norm(seen.xyz - np.median(seen.xyz, axis=0), axis=1)))
    least = max(STRAY_RATIO * float(np.quantile(distance, 0.25)), SUSPECT_SHARE * spread)
    belief = _Belief(found.misfit, spread, float((distance > least).mean()))
    # Rows that the mistakes are tried on, spread over the session
    rows = np.unique(np.linspace(0, len(session) - 1, 100).astype(int))
    if found.misfit < SUSPECT_SHARE * spread:
        signs = _signs(model, seen.take(np.unique(rows * len(seen) // len(session))), found.misfit)
        return dataclasses.replace(belief, signs=signs)
    own = register(Sightings.of(model, session.take(rows))).misfit
    tried = [
        (register(Sightings.of(model, m.rows.take(rows))).misfit, m)
        for m in mistakes(model.arm, session)
    ]
    best = min(misfit for misfit, _ in tried)
    if best > TELLING_SHARE * own:
        return belief
    first = next(m for misfit, m in tried if misfit <= ALIKE_RATIO * best)
    undone = register(Sightings.of(model, first.rows)).misfit
    return dataclasses.replace(belief, mistake=first.what, undone=undone)


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


def mistakes(arm: Arm, session: Session) -> Iterator[_Mistake]:
    """The session with each common mistake undone."""
    q, n = session.q, session.n
    turning = [arm.joints[row - 1].type == "revolute" for row in arm.commanded]

    def joint(j: int, values: np.ndarray) -> Session:
        changed = q.copy()
        changed[:, j] = values
        return dataclasses.replace(session, q=changed)

    for rows in (1, -1, 2, -2):
        where = "later" if rows < 0 else "earlier"
        times = "one row" if abs(rows) == 1 else f"{abs(rows)} rows"
        moved = np.roll(session.xyz, rows, axis=0)
        yield _Mistake(
            f"x, y, z look written {times} {where} than their joints", _with(session, moved)
        )
    yield _Mistake(
        "x, y, z look mirrored: two of them are swapped or one is negated",
        _with(session, session.xyz * (1.0, 1.0, -1.0)),
    )
    for j in range(n):
        yield _Mistake(f"q{j + 1} looks negated", joint(j, -q[:, j]))
        if not turning[j]:
            continue
        for text, angle in (
            ("half a turn", np.pi),
            ("a quarter turn", np.pi / 2),
            ("minus a quarter turn", -np.pi / 2),
        ):
            yield _Mistake(f"q{j + 1} looks offset by {text}", joint(j, q[:, j] - angle))
            if angle > 0:
                yield _Mistake(
                    f"q{j + 1} looks negated and offset by {text}", joint(j, angle - q[:, j])
                )
        yield _Mistake(f"q{j + 1} looks given in degrees", joint(j, np.radians(q[:, j])))
    for j, k in combinations(range(n), 2):
        order = np.arange(n)
        order[[j, k]] = k, j
        yield _Mistake(
            f"q{j + 1} and q{k + 1} look swapped", dataclasses.replace(session, q=q[:, order])
        )


def _with(session: Session, xyz: np.ndarray) -> Session:
    return dataclasses.replace(session, xyz=xyz)
