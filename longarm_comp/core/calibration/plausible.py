"""Whether a finished fit may be believed; a model that may not be is never written."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.calibration.noise import ENOUGH_REPEATS
from longarm_comp.core.calibration.standing import misplaced
from longarm_comp.core.data.measurement import errors
from longarm_comp.core.data.registration import median_distance, median_spread
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import JobError
from longarm_comp.core.model.model import Model

WORSE = 1.5
"""Held-out error of a model, in that of placed frames alone, from which it is worse."""
RISES = 4.0
"""Held-out error, in that of the fitted rows, from which the fit does not carry over."""
NO_NOISE = 0.05
"""Noise, as a share of the sightings' spread, that no instrument has."""
INCREDIBLE = 15.0
"""Size of an effect, in its prior standard deviations, that no arm has."""


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
    if rise := _rise(plain, held_out, WORSE):
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


def _rise(before: np.ndarray, held_out: np.ndarray, most: float) -> str:
    """Median errors (thousandths) before and at (M, 3) held-out rows that are so many times off."""
    here, there = 1e3 * median_distance(before), 1e3 * median_distance(held_out)
    risen = len(held_out) >= ENOUGH_REPEATS and there > most * here
    return f"{here:.3g} -> {there:.3g}" if risen else ""


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
