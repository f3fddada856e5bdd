"""Whether a finished fit may be believed; a model that may not be is never written."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy.special import chdtr

from longarm_comp.core.calibration.lasting import check_lasting
from longarm_comp.core.calibration.linear import BEFOREHAND
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.noise import ENOUGH_REPEATS
from longarm_comp.core.calibration.standing import misplaced
from longarm_comp.core.data.measurement import errors
from longarm_comp.core.data.registration import median_distance, median_spread
from longarm_comp.core.data.session import Session
from longarm_comp.core.data.set_aside import SetAside
from longarm_comp.core.errors import JobError
from longarm_comp.core.model.model import Model

WORSE = 1.5
"""Held-out error of a model, in that of placed frames alone, from which it is worse."""
WORST = 0.1
"""Share of the rows, the worst, that is looked at besides all: a tenth may be one joint's."""
RISES = 4.0
"""Held-out error, in that of the fitted rows, from which the fit does not carry over."""
NO_NOISE = 0.05
"""Noise, as a share of the sightings' spread, that no instrument has."""
UNLIKE = 1e-5
"""Chance of the noise along one axis beside that of the others, where they are as alike as a fit
takes them to be (`linear.BEFOREHAND`): 21 times, as of a camera's depth at 21 base lines."""
MOST_SHARING, MOST_ASIDE = 0.05, 0.2
"""Share of the rows that a fit may set aside: where they share something, and where they come
alone. A tenth of the rows is what instruments lose on a bad day."""
INCREDIBLE = 15.0
"""Size of an effect, in its prior standard deviations, that no arm has."""


def refuse(
    final: ModelFit,
    fitted: np.ndarray | None,
    held_out: np.ndarray,
    plainer: Mapping[str, np.ndarray],
    unit: str = "mm",
) -> SetAside:
    """What `calibrate` and `diagnose` have in common: a model that may not be believed is refused.

    Errors are of the rows that `believed` leaves of each, for gross errors that come alone are no
    fault of a model.

    Args:
        final: the model that would be written, fitted to all rows.
        fitted: (N, 3) its errors on rows that it was fitted to, m or rad; None where every row is
            held out, so that the error that is stated is one that carries over.
        held_out: (M, 3) errors of rows that were not fitted.
        plainer: errors of plainer models at the same held-out rows, by what they are called.
        unit: of a thousandth of these errors.

    Returns:
        The rows that the final fit set aside.

    Raises:
        JobError: the rows set aside are many or share something; the rows fall into two groups in
            order; the model is worse than a plainer one, fails at held-out rows, does not put the
            arm where it is seen, or has an effect of a size that no arm has.
    """
    session = final.session
    aside = check_set_aside(final)
    check_lasting(final)
    for than, errors_of in plainer.items():
        check_worth(held_out, errors_of, session.source, than, unit)
    if fitted is not None:
        check_carries_over(fitted, held_out, session.source, unit)
    check_fits(final.model, session)
    check_sizes(final.model, session.source)
    return aside


def believed(final: ModelFit, rows: Session) -> np.ndarray:
    """(M,) of any rows of the session that was fitted, whether the fit did not set them aside."""
    gone = set(_contents(final.session.take(final.outliers)))
    return np.array([each not in gone for each in _contents(rows)], dtype=bool)


def _contents(rows: Session) -> list[bytes]:
    """What stands in each row, by which it is known again."""
    return [row.tobytes() for row in np.column_stack([rows.index, rows.q, rows.xyz])]


def check_set_aside(final: ModelFit) -> SetAside:
    """Rows set aside must be few, and share nothing: else `JobError`."""
    found = SetAside.of(final.session, final.weights == 0)
    most = MOST_SHARING if found.shared_by else MOST_ASIDE
    if found.share > most:
        raise JobError(
            f"{found.summary}: a cause that this model lacks, not noise; correct arm.yaml or the "
            "rows there, or let longarm diagnose look for it",
            session=final.session.source,
        )
    return found


def check_worth(
    held_out: np.ndarray,
    plain: np.ndarray,
    source: str,
    than: str = "placed frames alone",
    unit: str = "mm",
) -> None:
    """A model must not be worse on held-out rows than a plainer one: else `JobError`.

    Args:
        held_out, plain: (M, 3) errors of the two there, m or rad.
        source, than: file of the rows, and the plainer model, for the message.
        unit: of a thousandth of these errors.
    """
    if rise := _rise(plain, held_out, WORSE, WORST):
        raise JobError(
            f"calibration is worse on held-out rows than {than}: {rise} {unit}; the rows do not "
            "determine the geometry, or are not of this arm",
            session=source,
        )


def check_carries_over(
    fitted: np.ndarray, held_out: np.ndarray, source: str, unit: str = "mm"
) -> None:
    """A model must do on unseen rows what it does on those that it was fitted to: else `JobError`.

    Args:
        fitted, held_out: (N, 3) and (M, 3) its errors on the fitted and the other rows, m or rad.
        source, unit: as of `check_worth`.
    """
    if rise := _rise(fitted, held_out, RISES):
        raise JobError(
            f"calibration fails at held-out rows: {rise} {unit}; there are too few rows, or "
            "something changed between them",
            session=source,
        )


def _rise(before: np.ndarray, held_out: np.ndarray, most: float, *shares: float) -> str:
    """Errors (thousandths) before and at (M, 3) held-out rows whose mean, or that of a worst share
    of them, is so many times off."""
    for share in (1.0, *shares):
        here, there = (1e3 * _mean_of_worst(each, share) for each in (before, held_out))
        if len(held_out) >= ENOUGH_REPEATS and there > most * here:
            of = "mean" if share == 1.0 else f"mean of the worst {share:.0%}"
            return f"{of} {here:.3g} -> {there:.3g}"
    return ""


def _mean_of_worst(error: np.ndarray, share: float) -> float:
    """Mean length of the largest share of (N, 3) errors."""
    length = np.sort(np.linalg.norm(error, axis=1))
    return float(length[-math.ceil(share * len(length)) :].mean()) if len(length) else 0.0


def displaced(model: Model, session: Session) -> str:
    """How far the arm is from where a model puts it, in words; empty where it is there."""
    if off := _off(model, session):
        return (
            f"the arm is {1e3 * off:.3g} mm from where the model expects it; "
            "calibrate first, which finds base and tip, and use that model"
        )
    return ""


def check_fits(model: Model, session: Session) -> None:
    """A fitted arm must be where its rows see it, whatever they measure: else `JobError`."""
    if off := _off(model, session):
        raise JobError(
            f"{1e3 * off:.3g} mm is left after calibration, so the rows are not of this arm: "
            "check their order, the units and the names of joints and anchors",
            session=session.source,
        )


def _off(model: Model, session: Session) -> float:
    """Median error of a misplaced arm, m; 0 of one that is in its place."""
    rows = session.take(session.placed)
    if len(rows) < ENOUGH_REPEATS or not misplaced(model, rows):
        return 0.0
    return median_distance(errors(model, rows))


def check_noise(sigma: np.ndarray, session: Session) -> None:
    """Raise `JobError` where no instrument has such a noise (d,) in its positions (m)."""
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
    seen = session.take(session.located & (session.frames == session.frames[0])).xyz
    if len(seen) < 2:
        return
    spread, size = median_spread(seen), float(np.linalg.norm(sigma[:3]))
    if size > NO_NOISE * spread:
        raise JobError(
            f"{1e3 * size:.3g} mm is left, which is more than noise: the sightings spread over "
            f"{1e3 * spread:.3g} mm only; look at the placement, the units and the order of the "
            "rows",
            session=session.source,
        )


def check_sizes(model: Model, source: str) -> None:
    """Raise `JobError` where an effect is of a size that no arm has (a tip mass of 89 kg)."""
    for slot in model.slots:
        value, p = slot.value, slot.parameter
        if not slot.owner.geometry and abs(value) > INCREDIBLE * p.prior:
            raise JobError(
                f"{slot.owner.name} at {slot.owner.where}: {p.name} {value:.3g} {p.unit} is not "
                f"credible (typical {p.prior:.2g}); the rows do not belong to this arm, or "
                "something else is missing",
                session=source,
            )
