"""The uncertainty of a fitted model at poses to which it was not fitted; every command reads it.

The posterior of a fit is too certain if the form of the model is not quite right: the error by what
the model lacks is similar in similar rows, so many rows count as few.  Therefore rows are left out,
one part of a joint's range at a time and in small random parts.  The error of the fit at these rows
is computed from the design (no fit is repeated).  A diagnosis chooses its effects anew without each
row, and these errors are taken for the random parts.  An error that no parameter explains is added,
so that 90 % of the rows left out lie inside the stated radius (split conformal; Vovk 2015, Ann.
Math. Artif. Intell. 74).  Rows that the fit set aside count as far as the arm may have been there.
The added error may be larger than the errors in the random parts allow. Then the covariance of the
parameters is multiplied instead, as if there were fewer rows, so the error grows with the distance
from the rows.

Not all of a fit's residual is noise.  The arm behaves similarly at similar poses, so an error that
the model lacks looks as if the parameters changed with the joints.  The residual is modelled as
white noise plus such a Gaussian process.  Their shares follow from the evidence of the rows, with
the part that the fit explains projected out (restricted likelihood; Patterson and Thompson 1971,
Biometrika 58), and from repeats.  The sensor's share in the variance of the residual is limited
(`share_of_sensor`). It cannot exceed the noise that the rows state, nor that of most rows: a few
large errors are the arm's. Scatter also is not sensor noise if it turns with the tool, grows with
the levers of the joints, or has two centres.

Every long arm bends under load. If the rows do not show this, the fit has explained it by the
geometry.  The measuring device may drift too: if the rows were measured along one joint's range,
this looks like an error of this joint.  So the covariance is that of the fitted parameters together
with the compliances and the drift that were not fitted.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from longarm_comp.core.arm.context import CLOCK, ORDER, is_told
from longarm_comp.core.calibration import linear
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.left_out import LeftOut
from longarm_comp.core.calibration.model_fit import ModelFit, choose_evenly, prior_widths
from longarm_comp.core.calibration.noise import (
    SHARES,
    lag_correlation,
    repeat_scatter,
    rows_as_one,
    share_of_sensor,
)
from longarm_comp.core.data.commanded import moved_by_measuring, moved_with_time
from longarm_comp.core.data.measurement import make_equations
from longarm_comp.core.effects.camera_errors import CameraDrift
from longarm_comp.core.effects.catalogue import possible_compliances
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.model.domain import RowDomain, least_moved
from longarm_comp.core.model.model import Model, slots_of
from longarm_comp.core.model.uncertainty import YIELDS, ModelUncertainty, factor_of, sizes

FRAME = 2.0
"""Possible error of a frame, in standard deviations of its motion during the session.

The ends of a steady drift lie 1.7 standard deviations from its mean, those of a decaying one more.
"""


def with_uncertainty(fit: ModelFit) -> Model:
    """Return the fitted model with its uncertainty and the time at which its session ended."""
    record = measure_uncertainty(fit)
    return dataclasses.replace(fit.model, uncertainty=record, ended_s=fit.session.ended_s)


def measure_uncertainty(fit: ModelFit, anew: np.ndarray | None = None) -> ModelUncertainty:
    """Estimate the uncertainty of a fit.

    Noise and structure come from its errors at rows that are left out of it. If too few rows hold a
    position or a touch, the noise of the fit is taken instead.

    Args:
        fit: the fit.
        anew: errors at rows for which its effects were chosen anew, as `LeftOut.of` takes them.
    """
    kept, alike = fit.weights > 0, 1.0
    pointed = fit.has_point & kept
    arm = fit.model.arm
    least = least_moved(arm)
    domain = RowDomain.of(fit.session.q[pointed if pointed.any() else kept], least)
    left_out = LeftOut.of(fit, anew)
    if left_out is None:
        lengths = fit.noise_m[fit.metres > 0]  # no position tells what a row leaves
        noise, structure = np.eye(3) * (lengths**2).sum() / max(len(lengths), 1), np.zeros((3, 3))
    else:
        spread = (fit.residual[pointed][:, :3] ** 2).mean(axis=0)
        usual = fit.sigma[:3] ** 2 * (1.0 / fit.weights[pointed]).mean()  # of most rows
        sensor = min(1.0 - estimate_arm_share(fit), share_of_sensor(fit).share)
        noise = np.diag(np.minimum(sensor * spread, usual))
        alike, structure = left_out.find_least_errors(noise)
    rho = lag_correlation(fit.residual / fit.sigma, fit.weights, fit.session.measured)
    alike = max(alike, rows_as_one(rho) / rows_as_one(fit.rho))
    # A target may be meant in the frame of any row, while one is used: the mean one, or that of the
    # session's start (`frame_shift`). If the base moved or seemed to, that of the end counts too
    rows = fit.session.take(kept)
    moved = moved_by_measuring(fit.model, rows)
    since = moved_with_time(fit.model, rows, float(np.trace(noise)) / 3.0)
    moved = moved - fit.model.frame_shift if len(moved) else moved
    frames = (FRAME * each for each in (moved, since) if len(each))
    frame = np.sum([np.zeros((3, 3)), *(off.T @ off / len(off) for off in frames)], axis=0)
    # Range of each circumstance that a command knows, except time; the declared value without rows
    payload, warmth = arm.payload, arm.reference_temperature_c
    circumstances = {"temperature_c": (warmth, warmth)}
    if payload is not None:  # as declared where the rows do not say it
        circumstances["payload_kg"] = (payload.mass_kg, payload.mass_kg)
    for j, joint in enumerate(rows.q.T, 1):
        circumstances[f"q{j}"] = (float(joint.min()), float(joint.max()))
    for name, column in fit.session.columns.items():
        values = np.asarray(column, dtype=float)[kept]
        if is_told(name) and name not in (CLOCK, ORDER) and np.isfinite(values).any():
            circumstances[name] = (float(np.nanmin(values)), float(np.nanmax(values)))
    absent = possible_compliances(arm, {term.key for term in fit.model.terms})
    slots = (*fit.slots, *slots_of(arm, absent))
    covariance, drift = _covariance_with_absent(fit, absent, alike)
    frame += FRAME**2 * np.outer(drift, drift) * float(rows.share_of_time.var())
    record = ModelUncertainty(
        tuple(slot.identity for slot in slots),
        factor_of(covariance),
        structure,
        noise,
        largest_m=0.0,
        rows=int(kept.sum()),
        frame=frame,
        circumstances=circumstances,
        absent=absent,
        domain=domain,
    )
    if not pointed.any():
        return record
    arm_side = [k for k, slot in enumerate(slots) if isinstance(slot.owner, Effect)]
    columns = _columns_with_absent(fit, absent)[pointed][:, :3, arm_side]
    covariance = record.carry_to_tip(columns, [slots[k].identity for k in arm_side])
    structure = record.structure_at(fit.session.q[pointed], least)
    expected = sizes(covariance + structure + record.frame)[0]
    return dataclasses.replace(record, largest_m=float(expected.max()))


def _columns_with_absent(fit: ModelFit, absent: Sequence[Effect]) -> np.ndarray:
    """Return the columns of a fit's p parameters and of k of absent effects, (N, d, p + k).

    They are derivatives by the parameters in their own units.
    """
    further = FitColumns(fit).prior_columns(absent) / prior_widths(slots_of(fit.model.arm, absent))
    return np.concatenate([fit.columns, further], axis=-1)


def _covariance_with_absent(
    fit: ModelFit, absent: Sequence[Effect], alike: float
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the covariance of the fitted parameters together with k absent ones.

    The prior of every compliance is at least `YIELDS` times its usual one, also if the fit had a
    narrower prior.  The prior of the drift is that of `CameraDrift` over the session; without a
    recorded time, over an hour.  If the rows then prefer other values than the model's, the squared
    differences are added.

    Args:
        absent: elastic effects that the fit does not hold.
        alike: the number of rows that count as one; the prior variances of other fitted parameters
            are multiplied by it too.

    Returns:
        The covariance (p + k, p + k), and the steady drift (3,), m from the first row to the last,
        that the rows prefer.
    """
    arm, rows, count = fit.model.arm, fit.session, len(fit.slots)
    slots = (*fit.slots, *slots_of(arm, absent))
    usual = prior_widths(slots_of(arm, [*fit.model.terms, *absent]))
    elastic = np.array([s.owner.elastic for s in slots])
    held = np.where(np.arange(len(slots)) < count, prior_widths(slots), 0.0)
    wider = elastic & (held < YIELDS * usual)
    width = np.where(wider, YIELDS * usual, math.sqrt(alike) * held)
    values = np.concatenate([fit.model.values, np.zeros(len(slots) - count)])
    # The usual drift during the session, m; nearly 0 if an effect of time alone is in the model
    held_drift = any(t.inputs and {CLOCK, ORDER}.issuperset(t.inputs) for t in fit.model.terms)
    hours = 1.0 if rows.t_s is None else float(np.ptp(rows.t_s)) / 3600.0
    rates = np.array([p.prior for p in CameraDrift().parameters(arm)])
    drifts = np.maximum(rates * (0.0 if held_drift else hours), 1e-12)
    pull = np.eye(3) if rows.plain else make_equations(fit.model, rows, (), at=fit.posture).pull
    since_mean = (rows.share_of_time - rows.share_of_time.mean())[:, None, None]
    columns = [_columns_with_absent(fit, absent) * width, np.asarray(pull * since_mean) * drifts]
    white = fit.whiten_columns(np.concatenate(columns, axis=-1))
    width, values = np.append(width, drifts), np.append(values, np.zeros(3))
    asked = white.T @ fit.whiten_columns(fit.residual[..., None])[:, 0] / alike - values / width
    limits = [
        (np.array([*(getattr(s.parameter, end) for s in slots), *[far] * 3]) - values) / width
        for end, far in (("lower", -np.inf), ("upper", np.inf))
    ]
    found = linear.solve_products(white.T @ white / alike, asked, *limits)
    off = (found.covariance + np.outer(found.u, found.u)) * np.outer(width, width)
    return off[:-3, :-3], (found.u * width)[-3:]


ROWS = 200
"""Largest number of rows, spread over the session, from which `estimate_arm_share` estimates. With
three axes they give 600 equations."""
WIDTHS = (0.25, 0.5, 1.0)
"""Correlation lengths of the Gaussian process, as fractions of an input's range."""
_NOTHING = 1e-8  # of the largest: rounding


def estimate_arm_share(fit: ModelFit) -> float:
    """Return the expected share of the arm in the residual's variance, 0 to 1.

    The rest is noise. All tried shares (`SHARES`) have the same prior probability.
    """
    kept = choose_evenly(np.flatnonzero((fit.weights > 0) & fit.has_point), ROWS)
    residual = fit.residual[kept][:, :3] * np.sqrt(fit.weights[kept])[:, None]
    size = np.maximum(np.sqrt((residual**2).mean(axis=0)), 1e-12)
    scale = np.array([slot.parameter.prior for slot in fit.slots])
    flat = (fit.columns[kept][:, :3] * scale / size[:, None]).reshape(3 * len(kept), -1)
    length = np.linalg.norm(flat, axis=0)
    moving = length > _NOTHING * length.max(initial=0.0)
    flat = flat[:, moving] / length[moving]  # each may change with the joints alike
    u, s, _ = np.linalg.svd(flat)
    free = u[:, int((s > _NOTHING * s.max(initial=0.0)).sum()) :]
    session = fit.session
    inputs = [session.q, session.approach, *(v[:, None] for v in session.columns.values())]
    x = np.concatenate([np.asarray(c, float) for c in inputs], axis=1)
    span = np.ptp(x, axis=0)
    x = (x[:, span > 0] / span[span > 0])[kept]
    if free.shape[1] < 2 or not x.shape[1]:
        return 0.0
    y = free.T @ (residual / size).reshape(-1)
    alike = (flat @ flat.T).reshape(len(kept), 3, len(kept), 3)
    apart = (x[:, None] - x[None]) ** 2
    logs = []
    for width in WIDTHS:
        each = np.exp(-0.5 * apart / width**2)
        for kernel in (each.mean(axis=2), each.prod(axis=2)):  # of one input at a time; of all
            process = (alike * kernel[:, None, :, None]).reshape(len(flat), -1)
            logs.append(_log_likelihood(free, y, process))
    log = np.array(logs) + _log_likelihood_of_repeats(fit, float((size**2).sum()))
    weight = np.exp(log - log.max()).sum(axis=0)
    return float(weight @ SHARES / weight.sum())


def _log_likelihood(free: np.ndarray, y: np.ndarray, process: np.ndarray) -> np.ndarray:
    """Return the log likelihood of the projected residual for each of the `SHARES`.

    The size of the residual is chosen to maximise it.

    Args:
        free: orthonormal basis of the space that the fit cannot explain, in columns.
        y: the residual projected to this space.
        process: covariance of the Gaussian process.
    """
    values, vectors = np.linalg.eigh(free.T @ process @ free)
    values = np.maximum(values, 0.0)
    z = vectors.T @ y
    variance = 1.0 + SHARES[:, None] * (values / max(values.mean(), 1e-300) - 1.0)
    size = (z**2 / variance).mean(axis=1)
    return np.asarray(-0.5 * (len(y) * np.log(size) + np.log(variance).sum(axis=1)))


def _log_likelihood_of_repeats(fit: ModelFit, whole: float) -> np.ndarray:
    """Return the log likelihood of the scatter of repeats for each of the `SHARES`.

    Args:
        whole: variance of the residual by arm and noise together, summed over three axes, m^2.
    """
    sigma, degrees = repeat_scatter(fit.model, fit.session)
    count = float(np.nansum(degrees[:3]))
    if not count or fit.session.blocks[0].kind != "position":
        return np.zeros(len(SHARES))
    noise = (1.0 - SHARES) * whole / 3.0
    square = float(np.nansum(degrees[:3] * np.nan_to_num(sigma[:3]) ** 2))
    return np.asarray(-0.5 * (count * np.log(noise) + square / noise))
