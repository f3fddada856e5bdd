"""Calibration: the geometry that is always fitted, and a ladder of fits with more and more terms.

The fits are compared on held-out poses.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.kind_of_arm import KindOfArm
from longarm_comp.core.calibration.linear import (
    BETTER,
    CHANCES,
    OUTLIER,
    SIZES,
    Marginal,
    choose_sizes,
)
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.noise import noise_from_residual
from longarm_comp.core.calibration.placed_model import place_as_seen, place_frames, placement_terms
from longarm_comp.core.calibration.undetermined import is_size_determined
from longarm_comp.core.data.commanded import commanded_errors
from longarm_comp.core.data.measurement import (
    compute_tip_errors,
    compute_touch_errors,
    compute_turn_errors,
)
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.catalogue import possible_compliances, through_others
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.geometry_errors import CylinderPins, DhError, JointZero
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.uncertainty import YIELDS

WORST = 5
"""Number of rows with the largest errors that are listed."""


@dataclass(frozen=True)
class Errors:
    """Statistics of the errors over a set of rows, in m, m^2 and rad.

    All lengths are NaN if no row measured the tip's position.

    Attributes:
        n: number of rows that measured the tip's position.
        mean, rms, p95, max, median: of the lengths of the position errors, m.
        mean_abs_z, variance: mean of ``|z|`` (m), and variance averaged over the three axes
            (m^2): the columns of the paper's Table I.
        angle: mean angle between measured and predicted orientation, rad; None if not measured.
        worst: numbers and error lengths (m) of the rows with the largest errors.
        spread: mean distance (m) of the tips from the touched points, which are solved from
            the same rows; None if nothing was touched.
    """

    n: int = 0
    mean: float = math.nan
    rms: float = math.nan
    p95: float = math.nan
    max: float = math.nan
    mean_abs_z: float = math.nan
    variance: float = math.nan
    angle: float | None = None
    median: float = math.nan
    worst: tuple[tuple[int, float], ...] = ()
    spread: float | None = None

    @property
    def mm(self) -> dict[str, float]:
        """The statistics in mm (mm^2), by their names in report.json."""
        names = ("mean", "median", "rms", "p95", "max", "mean_abs_z")
        lengths = {f"{name}_mm": 1e3 * getattr(self, name) for name in names}
        return lengths | {"variance_mm2": 1e6 * self.variance}

    @property
    def mean_text(self) -> str:
        """The mean error with its unit: mm, or mrad if only orientations were measured."""
        if self.n or self.angle is None:
            return f"{1e3 * self.mean:.2f} mm"
        return f"{1e3 * self.angle:.2f} mrad"

    @classmethod
    def of(
        cls,
        error: np.ndarray,
        turn: np.ndarray | None = None,
        *,
        numbers: np.ndarray | None = None,
        spread: np.ndarray | None = None,
    ) -> Errors:
        """Summarise the errors of a model at some rows.

        Args:
            error: (N, 3) measured - predicted positions of the tip, m.
            turn: (M, 3) rotation vectors from predicted to measured tip, rad.
            numbers: (N,) numbers of the rows, for `worst`; 0, 1, ... by default.
            spread: (K,) distances of the tip from touched points, m.
        """
        mean_turn = None
        about = float(spread.mean()) if spread is not None and len(spread) else None
        if turn is not None and len(turn):
            mean_turn = float(np.linalg.norm(turn, axis=1).mean())
        if not len(error):
            return cls(angle=mean_turn, spread=about)
        length = np.linalg.norm(error, axis=1)
        numbers = np.arange(len(error)) if numbers is None else numbers
        return cls(
            n=len(error),
            mean=float(length.mean()),
            rms=float(np.sqrt((length**2).mean())),
            p95=float(np.percentile(length, 95)),
            max=float(length.max()),
            mean_abs_z=float(np.abs(error[:, 2]).mean()),
            variance=float(error.var(axis=0).mean()),
            angle=mean_turn,
            median=float(np.median(length)),
            worst=tuple((int(numbers[k]), float(length[k])) for k in np.argsort(-length)[:WORST]),
            spread=about,
        )


@dataclass(frozen=True)
class Rung:
    """One rung of the ladder: a model, and its errors at training and held-out rows.

    Attributes:
        fit: its fit; None for the nominal arm.
        train, held_out: errors at these rows.
        commanded: held-out errors as a command would have them (`core/data/commanded.py`).
    """

    name: str
    model: Model
    fit: ModelFit | None
    train: Errors
    held_out: Errors
    commanded: Errors


def geometry_terms(arm: Arm, session: Session) -> tuple[Effect | Bias, ...]:
    """Return the terms that are always fitted: placements, joint zeros, DH rows, cylinder pins."""
    own = (*JointZero.for_arm(arm), *DhError.for_arm(arm), *CylinderPins.for_arm(arm))
    return (*placement_terms(arm, session), *own)


def fit_stages(
    model: Model,
    session: Session,
    progress: Callable[[str], None] | None = None,
    kind: KindOfArm | None = None,
) -> Iterator[tuple[str, ModelFit]]:
    """Yield three fits with their names: frames only, joint zeros, full geometry.

    Each adds terms to the model and starts from the fit before it; the frames are first placed in
    closed form.  The geometry is fitted twice, with the priors of the drawing and with the widest
    priors, because a part that is far off may only show with the latter.  The fit with the
    higher evidence is kept; it is what every command calls calibrated.  Errors are those of
    `fit_model`.

    Args:
        progress: called with each name before its fit.
        kind: prior of the full geometry from other arms of the same kind.
    """
    base = placement_terms(model.arm, session)
    start = placed = place_frames(model, session)
    borne = through_others(model.arm) if any(e.loaded for e in model.effects) else ()
    for name, terms in (
        ("frames_only", base),
        ("joint_zeros", (*base, *JointZero.for_arm(model.arm))),
        ("geometry", (*geometry_terms(model.arm, session), *borne)),
    ):
        if progress is not None:
            progress(name)
        whole, usual = model.with_missing(terms), None
        if kind is not None and name == "geometry":
            whole, usual, start = kind.apply_to(whole), kind.noise, placed
        whole = copy_known_values(start, whole)
        if name != "geometry":
            fitted = fit_model(whole, session, usual=usual)
        else:
            fitted = _settle_priors(whole, session, usual)
            wide = [(s.identity, SIZES[-1]) for s in whole.slots if not s.parameter.unknown]
            widest = dataclasses.replace(whole, beyond=tuple(wide))
            with contextlib.suppress(JobError):  # a part far off may show only if all may be
                other = _settle_priors(widest, session, usual)
                more = _log_evidence(other) - _log_evidence(fitted)
                if more > BETTER and is_size_determined(other):  # a smaller arm misses by less
                    fitted = other
        start = fitted.model
        yield name, fitted


def _settle_priors(model: Model, session: Session, usual: Mapping[str, float] | None) -> ModelFit:
    """Fit a model repeatedly until the set of parameters far beyond their priors repeats.

    These priors are widened before each further fit (`_find_beyond`).
    """
    fitted = fit_model(model, session, usual=usual)
    tried = [fitted.model.beyond]
    while (beyond := _find_beyond(fitted.model)) not in tried:
        tried.append(beyond)
        model = dataclasses.replace(fitted.model, beyond=beyond)
        fitted = fit_model(model, session, usual=usual)
    return fitted


def _log_evidence(fit: ModelFit) -> float:
    """Return the log evidence of a fit, including its noise and the cost of widened priors.

    Every long arm bends, so compliances that the fit lacks are marginalised. Otherwise a geometry
    far off its drawing would stand in for them. A row that is set aside counts as one at the limit
    of an outlier.
    """
    arm = fit.model.arm
    absent = possible_compliances(arm, {term.key for term in fit.model.terms})
    yields = YIELDS * FitColumns(fit).prior_columns(absent)
    noise, weights = noise_from_residual(fit, yields)
    fit = dataclasses.replace(fit, sigma=noise.sigma, weights=weights)
    design = np.concatenate([fit.design, fit.whiten_columns(yields)], axis=1)
    rows = Marginal(design, fit.data).evidence
    sigma = np.where(np.isfinite(fit.sigma), fit.sigma, 1.0)
    rows -= float(fit.session.measured.sum(axis=0) @ np.log(sigma))
    rows -= 0.5 * OUTLIER**2 * float((fit.weights == 0).sum())
    chance = dict(zip(SIZES, CHANCES, strict=True))
    return rows + sum(chance[size] - chance[1.0] for _, size in fit.model.beyond)


def _find_beyond(model: Model) -> tuple[tuple[tuple[object, ...], float], ...]:
    """Return `Model.beyond` for a model's values: parameters far beyond their priors, and factors.

    A factor (one of `SIZES`) widens the standard deviation of a prior. This costs a fixed amount of
    log evidence (`CHANCES`). Without it, an effect that moves the tip in the same way would be
    preferred only because this prior is narrow.
    """
    bare = dataclasses.replace(model, beyond=())
    slots = [s for s in bare.slots if not s.parameter.unknown]
    shares = np.array([s.value / s.parameter.width for s in slots])
    every = np.ones((len(slots), 1))
    sizes = choose_sizes(shares, every * SIZES, every * CHANCES)[0].tolist()
    return tuple((s.identity, f) for s, f in zip(slots, sizes, strict=True) if f != 1.0)


def fit_ladder(
    arm: Arm,
    train: Session,
    held_out: Session,
    effects: Sequence[tuple[str, tuple[Effect | Bias, ...]]] = (),
    *,
    deflection: bool = True,
    progress: Callable[[str], None] | None = None,
    kind: KindOfArm | None = None,
) -> list[Rung]:
    """Return the rungs: nominal arm, frames only, joint zeros, full geometry, then the effects.

    The nominal arm is not fitted, but placed if the rows show it elsewhere (`place_as_seen`).

    Args:
        train: rows that are fitted.
        held_out: rows that are never fitted, for the held-out errors.
        effects: (name, terms) of further rungs; each adds its terms to the model before it.
        deflection: whether declared beams sag, in all rungs.
        progress, kind: as in `fit_stages`.

    Raises:
        InputError: too few rows, or an input that an effect needs is missing.
    """
    if not train.seen.any() or not held_out.seen.any():
        raise InputError(train.source, "xyz", "no seen rows", "some to train and to hold out")

    def rung(name: str, model: Model, fitted: ModelFit | None) -> Rung:
        fit_to, left_out = (
            Errors.of(
                compute_tip_errors(model, rows),
                compute_turn_errors(model, rows),
                spread=compute_touch_errors(model, rows),
            )
            for rows in (train, held_out)
        )
        commanded = Errors.of(commanded_errors(model, held_out))
        return Rung(name, model, fitted, fit_to, left_out, commanded)

    base = declared_model(arm, deflection=deflection)
    rungs = [rung("nominal", place_as_seen(base, train).model, None)]
    for name, fitted in fit_stages(base, train, progress, kind):
        rungs.append(rung(name, fitted.model, fitted))
    for name, terms in effects:
        if progress is not None:
            progress(name)
        fitted = fit_model(rungs[-1].model.plus(*terms), train)
        rungs.append(rung(name, fitted.model, fitted))
    return rungs


def copy_known_values(known: Model, model: Model) -> Model:
    """Return a model with the values of a known model for the parameters that both have."""
    values = {s.identity: s.value for s in known.slots}
    return model.with_values(np.array([values.get(s.identity, s.value) for s in model.slots]))
