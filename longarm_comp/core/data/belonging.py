"""Checks whether the rows of a session belong to the arm, and finds common mistakes in them.

The model's arm is registered to the sightings (`registration`) twice: with the rows as they are,
and with each common mistake undone.  A mistake that explains much of the misfit is reported, but
not repaired.  Distances are limited, so that single gross errors do not dominate.  A mistake in one
joint may spoil only the few rows in which it moves.  So every mistake is also tried on the rows far
off the others, with the arm placed by the others.
"""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations, permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.kinds import compute_rotations
from longarm_comp.core.data.registration import Registration, Sightings, median_spread, register
from longarm_comp.core.data.session import Session
from longarm_comp.core.data.set_aside import FEW, SIGNIFICANT, SetAside
from longarm_comp.core.effects.sites import near
from longarm_comp.core.model.model import Model

MIN_POSES = 20
"""Smallest number of poses for the check: two for each unknown of a base and a marker."""
_SUSPECT_SHARE = 0.015
"""Misfit, over the spread of the sightings, from which on the mistakes are tried.

The errors of an uncalibrated arm are smaller, those of a mistake larger.
"""
_STRANGE_SHARE = 0.25
"""Misfit over the spread from which on rows are not this arm's; a row's distance is limited to it.
"""
_TELLING_SHARE = 0.7
"""A mistake is reported if undoing it leaves less than this of the misfit: half of its square."""
_ALIKE_RATIO = 1.02
"""Largest ratio of misfits at which two mistakes count as equal; the first one is reported."""
_STRAY_RATIO, MOST_STRAYS = 8.0, 0.3
"""A row strays if it is `_STRAY_RATIO` times farther off than the closest quarter of the rows.

Normal errors do not stray.  Up to a fraction `MOST_STRAYS` of the rows may stray, because the
median of the others still fits.
"""
SUSPECT_TURN, _STRANGE_TURN = 0.1, 0.5
"""Angles (rad) of the tip's axes that correspond to `_SUSPECT_SHARE` and `_STRANGE_SHARE`."""


@dataclass(frozen=True)
class _Belief:
    """The misfit of rows to an arm whose base and markers are placed by these rows."""

    misfit: float  # median distance of the rows, as they are, from the arm, m
    spread: float  # median distance of the sightings from their middle, m
    strays: SetAside  # rows that are `_STRAY_RATIO` times farther off than the closest quarter
    mistake: str = ""  # the mistake that was found, in words; empty if none
    fall: str = ""  # the errors with the mistake and without it, in words
    signs: tuple[tuple[int, float], ...] = ()  # as returned by `_find_unknown_signs`

    @property
    def belong(self) -> bool:
        """True if the rows may be this arm's."""
        near = self.misfit < _STRANGE_SHARE * self.spread
        return not self.mistake and near and not self.is_scattered

    @property
    def is_scattered(self) -> bool:
        """True if many rows stray and have nothing in common.

        A common trait would be a cause that a fit can find, such as friction by side of arrival.
        """
        return self.strays.share >= MOST_STRAYS and not self.strays.shared_by


def find_mistake(model: Model, session: Session) -> _Belief | None:
    """Check whether the rows belong to the arm, and look for a mistake in them.

    The common mistakes are tried on all rows if these fit badly, and on rows far off the others if
    there are several. Otherwise measured axes, or else the signs of joints, are checked.

    Returns:
        The findings; None for fewer than `MIN_POSES` different poses with a position.
    """
    seen = session.take(session.has_position)
    if len(np.unique(seen.pose_id)) < MIN_POSES:
        return None
    found = register(Sightings.of(model, session))
    spread = median_spread(seen.xyz)
    least = max(_STRAY_RATIO * float(np.quantile(found.distance, 0.25)), _SUSPECT_SHARE * spread)
    belief = _Belief(found.misfit, spread, SetAside.of(seen, found.distance > least))
    mistake, explained = None, False
    if _mean_distance(found, spread) >= _SUSPECT_SHARE * spread:
        names, undone = _find_mistakes(model, session, _split_at_shift(session, found), spread)
        left = register(Sightings.of(model, undone)).distance.mean()
        fall = f"{1e3 * found.distance.mean():.3g} -> {1e3 * left:.3g} mm"
        if left > _SUSPECT_SHARE * spread:
            fall += ", so more is wrong, or it is something else"
        else:
            explained = bool(names)
        mistake = " and ".join(names), fall
    if not explained and len(belief.strays.rows) >= FEW:
        mistake = _find_mistake_in_part(model, session, found, least) or mistake
    mistake = mistake or _find_mistake_of_axes(model, session)
    if mistake is not None:
        return dataclasses.replace(belief, mistake=mistake[0], fall=mistake[1])
    if (session.has_position & session.has_orientation).any():  # axes of the tip show every sign
        return belief
    signs = _find_unknown_signs(model, seen.take(sample_rows(seen)), found.misfit)
    return dataclasses.replace(belief, signs=signs)


def sample_rows(session: Session) -> np.ndarray:
    """Return the numbers of at most 100 rows, evenly over the session."""
    return np.unique(np.linspace(0, len(session) - 1, 100).astype(int))


def _mean_distance(found: Registration, spread: float) -> float:
    """Return the mean distance of the rows (m), each limited to `_STRANGE_SHARE` of the spread."""
    return float(np.minimum(found.distance, _STRANGE_SHARE * spread).mean())


def _find_mistakes(
    model: Model, session: Session, parts: tuple[str, Session], spread: float
) -> tuple[list[str], Session]:
    """Find the mistakes that explain much of the misfit, and return the session without them.

    The one that explains most comes first; a further one is searched for while the remaining misfit
    is suspect.  `parts`, of `_split_at_shift`, counts as one more mistake.
    """

    def misfit(tried: Session) -> float:
        some = tried.take(sample_rows(tried))
        return _mean_distance(register(Sightings.of(model, some)), spread)

    names: list[str] = []
    own = misfit(session)
    while own > _SUSPECT_SHARE * spread and len(names) < session.n:
        every = (*undo_mistakes(model.arm, session), *(() if names else (parts,)))
        tried = [(misfit(undone), what, undone) for what, undone in every]
        best = min(left for left, *_ in tried)
        if best > _TELLING_SHARE * own:
            break
        own, what, session = next(t for t in tried if t[0] <= _ALIKE_RATIO * best)
        names.append(what)
    return names, session


def _find_mistake_in_part(
    model: Model, session: Session, found: Registration, least: float
) -> tuple[str, str] | None:
    """Find the mistake that explains most of the rows that are farther off than `least` (m).

    Base and markers stay where `found` places them.  A random error decreases to a fraction s of
    itself with the probability s^3; those of all these rows are combined (Fisher's method).  The
    result is None if no mistake is significant and explains more than half of the rows.
    """

    def distance(rows: Session) -> np.ndarray:
        at = Registration.at(Sightings.of(model, rows), found.rotation, found.offset, found.tip)
        made = np.full(len(rows), np.nan)
        made[rows.has_position] = at.distance
        return made

    from scipy.stats import chi2  # takes a quarter of a second

    far = (own := distance(session)) > least
    tried = []
    for what, undone in undo_mistakes(model.arm, session):
        left = distance(undone)[far]
        fall = np.clip(np.nan_to_num(left / own[far], nan=1.0), 1e-12, 1.0)
        chance = chi2.logsf(-6.0 * np.log(fall).sum(), 2 * len(fall))
        tried.append((chance, what, int((left < least).sum()), np.nanmedian(left)))
    chance, what, right, after = min(tried)
    if 2 * right <= far.sum() or chance + np.log(len(tried)) > np.log(SIGNIFICANT):
        return None
    said = f"{what} in {right} of the {far.sum()} rows that are far off the others"
    return said, f"{1e3 * np.median(own[far]):.3g} -> {1e3 * after:.3g} mm"


def _split_at_shift(session: Session, found: Registration) -> tuple[str, Session]:
    """Split the rows, in their order, in two parts that look measured from two bases.

    The split is where the cumulative sum of the residuals, limited in size and less their median,
    deviates most (Page 1954, Biometrika 41).  The later rows get a group of their own.
    """
    seen = np.flatnonzero(session.has_position)
    away = found.residual - np.median(found.residual, axis=0)
    bound = 3.0 * np.median(np.abs(away), axis=0) + 1e-12
    sums = np.cumsum(np.clip(away, -bound, bound) / bound, axis=0)[:-1]
    before = np.arange(1, len(sums) + 1)
    size = ((sums - sums[-1] * (before / len(away))[:, None]) ** 2).sum(axis=1)
    cut = int(np.argmax(size / (before * (len(away) - before)))) + 1
    first = seen[cut]
    while first and session.pose_id[first] == session.pose_id[first - 1]:
        first -= 1
    late = np.where(np.arange(len(session)) >= first, "moved", "")
    group = np.char.add(session.texts("group"), late)
    parts = dataclasses.replace(session, labels={**session.labels, "group": group})
    return f"row {first + 1} on looks measured from another base, or of another arm", parts


def turn_error(model: Model, rows: Session) -> Callable[[np.ndarray], float]:
    """Return a function that computes the mean error (rad) of measured orientations of the rows.

    Its argument is the quaternions x, y, z, w (N, 4) of N rows, which must all have a position.
    The base is placed by the positions, and the rotation of the measured body on the tool is free.
    """
    sightings = Sightings.of(model, rows)
    placed = register(sightings).rotation[sightings.group]
    axes = placed @ model.pose(rows.q, rows.context())[:, :3, :3]

    def error(values: np.ndarray) -> float:
        body = Rotation.from_matrix(np.swapaxes(axes, 1, 2) @ compute_rotations(values))
        return float((body * body.mean().inv()).magnitude().mean())

    return error


def _find_mistake_of_axes(model: Model, session: Session) -> tuple[str, str] | None:
    """Find the mistake in the format of the measured orientations.

    None if they fit, or fewer than `MIN_POSES` poses have both an orientation and a position.
    """
    rows = session.take(session.has_position & session.has_orientation)
    if len(np.unique(rows.pose_id)) < MIN_POSES:
        return None
    misfit, read = turn_error(model, rows), rows.readings["orientation"]
    own = misfit(read)
    if own < SUSPECT_TURN:
        return None
    tried = []
    swapped = (-1, "w, x, y, z read as x, y, z, w"), (1, "x, y, z, w read as w, x, y, z")
    for back, order in ((0, ""), *swapped):
        for sign, way in ((1.0, ""), (-1.0, "inverted: the base in the tool")):
            values = np.roll(read * (sign, sign, sign, 1.0), back, axis=1)
            what = "qx, qy, qz, qw look " + " and ".join(filter(None, (order, way)))
            tried.append((misfit(values), what))
    left, what = min(tried[1:], key=lambda t: t[0])
    if left > _TELLING_SHARE * own:
        if own < _STRANGE_TURN:
            return None
        left, what = own, "qx, qy, qz, qw are not those of the tip"
    return what, f"{1e3 * own:.4g} -> {1e3 * left:.3g} mrad"


def _find_unknown_signs(
    model: Model, rows: Session, misfit: float
) -> tuple[tuple[int, float], ...]:
    """Return the moving joints (0-based) whose sign the rows do not show.

    Each comes with the RMS distance (m) by which the tip moves if the joint is negated and base and
    tip are placed anew. It is less than `misfit` (m).
    """
    made = dataclasses.replace(rows, xyz=model.tip(rows.q, rows.context()))
    unknown = []
    for j in np.flatnonzero(np.ptp(rows.q, axis=0) > 0):
        q = rows.q.copy()
        q[:, j] *= -1
        moved = register(Sightings.of(model, dataclasses.replace(made, q=q))).residual
        size = float(np.sqrt((moved**2).sum(axis=1).mean()))
        if size < misfit:
            unknown.append((int(j), size))
    return tuple(unknown)


def undo_mistakes(arm: Arm, session: Session) -> Iterator[tuple[str, Session]]:
    """Yield each common mistake, in words, and the session with this mistake undone."""
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
    for k in range(3):
        if k < 2:  # z negated is mirrored
            negated = xyz * np.where(np.arange(3) == k, -1.0, 1.0)
            yield f"{'xy'[k]} looks negated", dataclasses.replace(session, xyz=negated)
        order = np.roll([0, 2, 1], k)
        swapped = dataclasses.replace(session, xyz=xyz[:, order])
        yield f"{' and '.join(np.array(list('xyz'))[order != np.arange(3)])} look swapped", swapped
    for j, slides in enumerate(arm.slides):
        name = f"q{j + 1} looks"
        yield f"{name} negated", joint(j, -q[:, j])
        if slides:
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
    for j, k in permutations(range(session.n), 2):
        if arm.slides[j] != arm.slides[k] or not near(j, k):
            continue
        for own, factor in product((1.0, -1.0), repeat=2):
            text = f"{'-' * (own < 0)}q{j + 1} {'-' if factor < 0 else '+'} q{k + 1}"
            coupled = joint(j, own * q[:, j] + factor * q[:, k])
            yield f"q{j + 1} looks coupled with q{k + 1}: the joint is {text}", coupled
