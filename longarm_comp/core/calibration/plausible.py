"""Refuses a finished fit that is not plausible, so that its model is never written."""

import math
from collections.abc import Mapping

import numpy as np
from scipy.special import chdtr, stdtrit

from longarm_comp.core.calibration.linear import BEFOREHAND
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.moved_parts import refuse_moved_parts
from longarm_comp.core.calibration.noise import ENOUGH_REPEATS
from longarm_comp.core.calibration.placed_model import is_misplaced
from longarm_comp.core.data.measurement import compute_tip_errors
from longarm_comp.core.data.registration import median_distance, median_spread
from longarm_comp.core.data.session import Session
from longarm_comp.core.data.set_aside import SetAside
from longarm_comp.core.errors import JobError
from longarm_comp.core.model.model import Model, slots_of

WORSE = 1.5
"""Ratio of a model's held-out error to that of a plainer model, above which it is refused."""
WORST = 0.1
"""Fraction of the rows, the worst ones, that is compared in addition to all rows.

A tenth of the rows may be those in which one joint is wrong.
"""
RISES = 4.0
"""Ratio of the held-out error to the error at fitted rows, above which a model is refused."""
NO_NOISE = 0.05
"""Ratio of the noise to the spread of the sightings, above which it is no instrument's noise."""
UNLIKE = 1e-5
"""Smallest plausible probability of the noise along one axis, given that of the other axes.

The axes are assumed to be as similar as a fit assumes (`linear.BEFOREHAND`).  The limit is at a
ratio of 21, as of a camera's depth at a distance of 21 base lines.
"""
MOST_SHARING, MOST_ASIDE = 0.05, 0.2
"""Largest fraction of rows set aside: if they have a trait in common, and if they are isolated.

On a bad day, instruments lose a tenth of the rows.
"""
INCREDIBLE = 15.0
"""Largest plausible size of an effect, in its prior standard deviations."""


def refuse_implausible(
    final: ModelFit,
    fitted: np.ndarray | None,
    held_out: np.ndarray,
    plainer: Mapping[str, np.ndarray],
    unit: str = "mm",
) -> SetAside:
    """Refuse a model that is not plausible, for `calibrate` and `diagnose`.

    The errors are those of the rows that `mark_believed_rows` keeps, because single gross errors
    are no fault of a model.

    Args:
        final: the model that would be written, fitted to all rows.
        fitted: (N, 3) its errors on rows that it was fitted to, m or rad; None if every row is
            held out, so that the stated error already holds for other rows.
        held_out: (M, 3) errors of rows that were not fitted, m or rad.
        plainer: errors (M, 3) of plainer models at the same held-out rows, by the models' names.
        unit: unit of a thousandth of these errors.

    Returns:
        The rows that the final fit set aside.

    Raises:
        JobError: too many rows were set aside, the more so if they have a trait in common; a base
            or marker moved while the rows were recorded; the model is worse than a plainer one,
            fails at held-out rows, or does not put the arm where it is measured; or an effect has
            an impossible size (a tip mass of 89 kg).
    """
    session, source = final.session, final.session.source
    aside = SetAside.of(session, final.weights == 0)
    if aside.share > (MOST_SHARING if aside.shared_by else MOST_ASIDE):
        look = "" if fitted is None else ", or let longarm diagnose look for it"
        raise JobError(
            f"{aside.summary}: a cause that this model lacks, not noise; correct arm.yaml or the "
            f"rows there{look}",
            session=source,
        )
    refuse_moved_parts(final)
    for than, plain in plainer.items():
        if rise := describe_rise(plain, held_out, WORSE, WORST):
            raise JobError(
                f"calibration is worse on held-out rows than {than}: {rise} {unit}; the rows do "
                "not determine the geometry, or are not of this arm",
                session=source,
            )
    if fitted is not None and (rise := describe_rise(fitted, held_out, RISES)):
        raise JobError(
            f"calibration fails at held-out rows: {rise} {unit}; there are too few rows, or "
            "something changed between them",
            session=source,
        )
    if off := measure_offset(final.model, session):
        raise JobError(
            f"{1e3 * off:.3g} mm is left after calibration, so the rows are not of this arm: "
            "check their order, the units and the names of joints and anchors",
            session=source,
        )
    for slot in slots_of(final.model.arm, final.model.terms):  # whatever the fit took for usual
        value, p = slot.value, slot.parameter
        if not slot.owner.geometry and abs(value) > INCREDIBLE * p.prior:
            raise JobError(
                f"{slot.owner.name} at {slot.owner.where}: {p.name} {value:.3g} {p.unit} is not "
                f"credible (typical {p.prior:.2g}); the rows do not belong to this arm, or "
                "something else is missing",
                session=source,
            )
    return aside


def mark_believed_rows(final: ModelFit, rows: Session) -> np.ndarray:
    """Return (M,) True for each row that the fit did not set aside as an outlier."""

    def contents(some: Session) -> list[bytes]:
        return [row.tobytes() for row in np.column_stack([some.index, some.q, some.xyz])]

    gone = set(contents(final.session.take(final.outliers)))
    return np.array([each not in gone for each in contents(rows)], dtype=bool)


def describe_rise(before: np.ndarray, held_out: np.ndarray, most: float, *shares: float) -> str:
    """Describe how much larger the errors at held-out rows are than other errors.

    Args:
        before: (N, 3) the errors to compare with, m or rad.
        held_out: (M, 3) errors at held-out rows, m or rad.
        most: factor by which the mean length may be larger.
        shares: fractions of the rows, the worst ones, whose mean is limited by this factor too.

    Returns:
        Both means in thousandths, in words; empty if no mean is larger by more than the factor. Of
        fewer rows than `ENOUGH_REPEATS` only all are compared, and must be beyond their scatter
        (Student's t, 95 %): a single row proves nothing.
    """
    lengths = [np.sort(np.linalg.norm(each, axis=1)) for each in (before, held_out)]
    if len(held_out) < ENOUGH_REPEATS:
        if min(len(before), len(held_out)) < 2:
            return ""
        here, there = (each.std(ddof=1) / math.sqrt(len(each)) for each in lengths)
        doubt, shares = stdtrit(len(held_out) - 1, 0.975) * math.hypot(most * here, there), ()
    else:
        doubt = 0.0
    for share in (1.0, *shares):
        here, there = (
            float(length[-math.ceil(share * len(length)) :].mean()) if len(length) else 0.0
            for length in lengths
        )
        if there > most * here + doubt:
            of = "mean" if share == 1.0 else f"mean of the worst {share:.0%}"
            return f"{of} {1e3 * here:.3g} -> {1e3 * there:.3g}"
    return ""


def measure_offset(model: Model, session: Session) -> float:
    """Return the median error (m) of a model, if it shows that the arm stands elsewhere; else 0."""
    rows = session.take(session.placed)
    if len(rows) < ENOUGH_REPEATS or not is_misplaced(model, rows):
        return 0.0
    return median_distance(compute_tip_errors(model, rows))


def describe_offset(model: Model, session: Session) -> str:
    """Return a text on how far the arm is from where a model puts it; "" if it is there."""
    off = measure_offset(model, session)
    if not off:
        return ""
    far = f"the arm is {1e3 * off:.3g} mm from where the model expects it"
    bases = (e.placement.get("group") for e in model.effects if e.base(model.arm) is not None)
    known = sorted(str(group) for group in bases if group)
    if known and not set(session.texts("group")) <= set(known):
        places = ", ".join(known)
        return f"{far}: name in a column group where the base stood ({places}), or calibrate first"
    return f"{far}; calibrate first, which finds base and tip, and use that model"


def check_noise(sigma: np.ndarray, session: Session) -> None:
    """Check that the fitted noise (d,) of positions is that of an instrument, m.

    Raises:
        JobError: the noise is large compared with the spread of the sightings, or one axis has
            much more noise than the others.
    """
    if session.blocks[0].kind != "position" or not np.isfinite(sigma[:3]).all():
        return
    axis, ratio = int(np.argmax(sigma[:3])), float((sigma[:3].max() / np.median(sigma[:3])) ** 2)
    if chdtr(BEFOREHAND, BEFOREHAND / ratio) < UNLIKE:
        usual = 1e3 * np.median(sigma[:3])
        raise JobError(
            f"{1e3 * sigma[axis]:.3g} mm is left along {'xyz'[axis]} beside {usual:.3g} mm, which "
            "is no instrument's noise; the rows may fall into groups, or a cause is missing",
            session=session.source,
        )
    seen = session.take(session.has_position & (session.frames == session.frames[0])).xyz
    if len(seen) < 2:
        return
    spread, size = median_spread(seen), float(np.linalg.norm(sigma[:3]))
    if size > NO_NOISE * spread:
        stated = np.linalg.norm([session.claimed_sigma.get(c, 0.0) for c in session.channels[:3]])
        left, look_at = "is left", "the placement, the units and the order of the rows"
        if stated >= 0.9 * size:  # the noise is what the rows state, whatever is left
            left, look_at = "is stated", "sigma_x, sigma_y, sigma_z or cov_xx .. and their units"
        raise JobError(
            f"{1e3 * size:.3g} mm {left}, which is more than noise: the sightings spread over "
            f"{1e3 * spread:.3g} mm only; look at {look_at}",
            session=session.source,
        )
