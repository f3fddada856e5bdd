"""Estimates the noise of the measurements: from enough repeats, else from a rich fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import expit, fdtri, log_ndtr, logsumexp, softmax

from longarm_comp.core.calibration import linear
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.linear import (
    BEFOREHAND,
    MAD,
    OUTLIER,
    channel_means,
    channel_medians,
)
from longarm_comp.core.calibration.model_fit import ModelFit, prior_widths
from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.data.measurement import make_equations
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.model.model import Model

ENOUGH_REPEATS = 15
"""Degrees of freedom that repeats must have to be trusted."""
ALLOWED = 1e-3
"""Chance of an axis, one of several in every session, to be noisier than its repeats allow."""
RIGHT_WITHIN = 2.0
"""Factor within which a sensor's stated noise is right: one standard deviation."""
EXCESS_WITHIN = 1e3
"""Range of what else may scatter the rows: from the least that matters to a thousand times that."""
NEWTON_STEPS = 10
MOST_STEPS = 60
"""Of the noise and the size of the library's effects together."""
LEAST_ROWS = 12
"""Rows from which the shape of their scatter tells something: two covariances of six numbers."""
SHARES = np.linspace(0.0, 0.95, 20)
"""Shares of the arm in what scatters that are tried; all are equally likely beforehand."""
TURNING = math.log(20.0)
"""Log odds, before the rows, that nothing scatters with the tool: one session in twenty."""
APART = 4.5
"""Distance of two groups of rows, in their scatter, from which hardly a row lies between them;
halves of even scatter, as of a coarse display, are 3.5 apart."""
EM_STEPS = 30
USUAL = 3e-4
"""Noise of a sighting before any row is seen, m or rad; a factor of `_WITHIN` is one standard
deviation."""
_WITHIN = 10.0
PLACES = ("group", "marker", *dict.fromkeys(k.label for k in KINDS.values() if k.label))
"""Text columns that say what is measured, and from where."""


@dataclass(frozen=True)
class NoiseEstimate:
    """The standard deviation per axis and the correlation from row to row.

    Attributes:
        sigma: (d,) of the session's channels, m or rad.
        source: ``repeats`` or ``residual``.
        rho: correlation of one row's noise with the next one's; 0 where insignificant.
        degrees: degrees of freedom per axis.
    """

    sigma: np.ndarray
    source: str
    rho: float
    degrees: float


def noise_from_repeats(model: Model, session: Session) -> NoiseEstimate | None:
    """Estimate the noise from repeats of a pose that was reached from the same side, if enough.

    The model's prediction for a pose is subtracted, so that the scatter is the same by any model.
    Repeats from different sides differ by hysteresis too, so each side is a group of its own, as
    is each anchor, marker and base.  Deviations beyond 4.2 robust standard deviations are left out.
    A row that repeats another to the last digit is a copy, and no second measurement.

    Returns:
        The noise, infinite in channels of too few repeats; None where all have too few.
    """
    size, degrees = repeat_scatter(model, session)
    enough = degrees >= ENOUGH_REPEATS
    if not enough.any():
        return None
    sigma = np.where(enough, np.maximum(size, 1e-7), np.inf)
    return NoiseEstimate(sigma, "repeats", 0.0, float(degrees[enough].min()))


def repeat_scatter(model: Model, session: Session) -> tuple[np.ndarray, np.ndarray]:
    """Return the (d,) scatter of repeats, as of `noise_from_repeats`, and degrees of freedom."""
    seen = session.take(session.seen)
    keys = np.column_stack([number_sightings(seen), seen.approach])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    if seen.plain:
        values = seen.xyz
    else:
        residual = make_equations(model, seen, ()).residual
        # Where the reading is that the joints stand so, the same joints again are no second
        # reading; nor is one of an encoder, which repeats its own error
        again = np.ones(len(seen), dtype=bool)
        again[np.unique(seen.q, axis=0, return_index=True)[1]] = False
        kinds = [KINDS[b.kind] for b in seen.blocks for _ in b.channels]
        stood = again[:, None] & np.array([not kind.cells for kind in kinds])
        second = ~stood & ~np.array([kind.of_joint for kind in kinds])
        values = np.where(seen.measured & second, residual, np.nan)
    whole = np.column_stack([keys, np.nan_to_num(values)])
    first = np.unique(whole, axis=0, return_index=True)[1]
    copy = ~np.isin(np.arange(len(seen)), first)
    values = np.where(copy[:, None], np.nan, values)
    scatter, share = _deviations_from_group(values, group.reshape(-1))
    robust = (
        MAD * channel_medians(np.abs(scatter)) / np.sqrt(np.maximum(channel_means(share), 1e-9))
    )
    kept = (np.nan_to_num(np.abs(scatter)) <= OUTLIER * np.maximum(robust, 1e-9)).all(axis=1)
    degrees = np.nansum(share[kept], axis=0)
    size = np.sqrt(np.nansum(scatter[kept] ** 2, axis=0) / np.maximum(degrees, 1e-9))
    return size, degrees


class SensorShare(NamedTuple):
    """How much of the white residual is the sensor's.

    Attributes:
        share: expected share of its variance.
        whole: probability that all of it is.
        sign: what shows the rest.
    """

    share: float
    whole: float
    sign: str


def share_of_sensor(fit: ModelFit) -> SensorShare:
    """Judge how much of the white residual is the sensor's.

    Either all of it is the sensor's, or something else that no input tells adds to it: two tools
    that nobody wrote down, a tool that is loose, an arm that does not come back.  Either what the
    rows state or the shape of the scatter may say so.
    """
    found, kept = [_share_by_statement(fit)], (fit.weights > 0) & fit.has_point
    if kept.sum() >= LEAST_ROWS and fit.session.blocks[0].kind == "position":
        residual = fit.residual[kept][:, :3] * np.sqrt(fit.weights[kept])[:, None]
        tip = np.broadcast_to(fit.model.tip_frame(fit.posture).matrix(), (len(fit.weights), 4, 4))
        by_tip = np.einsum("nji,nj->ni", tip[kept, :3, :3], residual)
        found.append(_share_by_shape(residual, by_tip))
        zeros = FitColumns(fit).prior_columns(JointZero.for_arm(fit.model.arm))[kept, :3]
        found.append(_share_by_joints(residual, zeros))
        found += map(_share_by_groups, (residual, by_tip))
    return min(found)


def _share_by_shape(residual: np.ndarray, by_tip: np.ndarray) -> SensorShare:
    """Judge it by the shape of the scatter: a sensor's does not turn with the tool.

    The residual is normal with one covariance in the frame of the measurements, or in that of the
    tip. In the latter case the sensor has what scatters alike in all directions.

    Args:
        residual, by_tip: (N, 3) m, in either frame.
    """
    logs, spread = [], np.zeros(3)
    for each in (residual, by_tip):
        spread = np.maximum(np.linalg.eigvalsh(each.T @ each / len(each)), 1e-30)
        logs.append(-0.5 * len(each) * float(np.log(spread).sum()))
    whole = float(expit(TURNING + logs[0] - logs[1]))
    share = whole + (1.0 - whole) * float(3.0 * spread[0] / spread.sum())
    return SensorShare(share, whole, "turns with the tool, as no sensor's noise does")


def _share_by_joints(residual: np.ndarray, columns: np.ndarray) -> SensorShare:
    """Judge it by the postures: joints that do not come back scatter as far as their levers reach.

    The residual is normal with one covariance; or the sensor scatters alike in all directions, and
    each joint by its unit besides. All shares are equally likely beforehand.

    Args:
        residual: (N, 3) m.
        columns: (N, 3, n) m for a unit of each joint.
    """
    levers = columns @ columns.transpose(0, 2, 1)
    reach, ways = np.linalg.eigh(levers / max(float(np.trace(levers.mean(axis=0))) / 3.0, 1e-30))
    square = np.einsum("nji,nj->ni", ways, residual) ** 2
    variance = 1.0 + SHARES[:, None, None] * (np.maximum(reach, 0.0) - 1.0)
    size = np.maximum((square / variance).mean(axis=(1, 2)), 1e-30)
    logs = -0.5 * (square.size * np.log(size) + np.log(variance).sum(axis=(1, 2)))
    spread = np.maximum(np.linalg.eigvalsh(residual.T @ residual / len(residual)), 1e-30)
    one = -0.5 * len(residual) * float(np.log(spread).sum())
    chances = softmax(logs)
    whole = float(expit(TURNING + one - logsumexp(logs) + math.log(len(SHARES))))
    share = whole + (1.0 - whole) * float(chances @ (1.0 - SHARES))
    return SensorShare(share, whole, "grows with the joints' levers, as no sensor's noise does")


def _share_by_groups(residual: np.ndarray) -> SensorShare:
    """Judge it by groups of rows: a sensor's scatter (N, 3), m, has one middle.

    It is normal about one middle, or about two with the same covariance. Then the sensor has what
    scatters about each of them.  The two must lie apart, because other noise than normal has long
    tails or none.
    """
    count, split = len(residual), residual @ np.linalg.eigh(residual.T @ residual)[1][:, -1] > 0
    there, whole, share, apart = split.astype(float), 1.0, 1.0, 0.0
    spread = np.cov(residual, rowvar=False, bias=True) + 1e-24 * np.eye(3)
    for _ in range(EM_STEPS):
        part = there.mean()
        if not 0.0 < part < 1.0:
            return SensorShare(1.0, 1.0, "")
        middles = [w @ residual / w.sum() for w in (there, 1.0 - there)]
        way = middles[0] - middles[1]
        within = spread - part * (1.0 - part) * np.outer(way, way)
        within += 1e-6 * np.trace(spread) * np.eye(3)  # rounding
        slope = np.linalg.solve(within, way)
        odds = math.log(part / (1.0 - part)) + (residual - 0.5 * (middles[0] + middles[1])) @ slope
        there, apart = expit(odds), math.sqrt(float(way @ slope))
    if apart > APART:
        logs = [-0.5 * count * float(np.linalg.slogdet(s)[1]) for s in (spread, within)]
        chosen = float(np.where(there > 0.5, np.log(part), np.log1p(-part)).sum())
        whole = float(expit(TURNING + logs[0] - logs[1] - chosen + 2.0 * math.log(count)))
        share = whole + (1.0 - whole) * float(np.trace(within) / np.trace(spread))
    size = 1e3 * float(np.linalg.norm(way))
    return SensorShare(share, whole, f"has two middles, {size:.3g} mm apart")


def _share_by_statement(fit: ModelFit) -> SensorShare:
    """Judge it by what the rows state of their noise: whatever else there is may be of any size."""
    sign = "is scatter far beyond the noise that the rows state"
    stated = [fit.session.claimed_sigma.get(name, math.nan) for name in fit.session.channels]
    ratios = np.log(fit.sigma) - np.log(stated)
    if not np.isfinite(ratios).any():
        return SensorShare(1.0, 1.0, sign)
    within, ratio = math.log(RIGHT_WITHIN), float(ratios[np.isfinite(ratios)].mean())
    log_less = log_ndtr(ratio / within)
    log_density = -0.5 * (ratio / within) ** 2 - math.log(within * math.sqrt(2.0 * math.pi))
    log_all = log_density - log_less + math.log(math.log(EXCESS_WITHIN))
    whole = float(expit(log_all))
    log_part = log_ndtr(ratio / within - 2.0 * within) - log_less + 2.0 * (within**2 - ratio)
    return SensorShare(whole + (1.0 - whole) * math.exp(min(log_part, 0.0)), whole, sign)


def number_sightings(rows: Session) -> np.ndarray:
    """Return (N, k) numbers of each row's pose, target and standpoint, which repeats share."""
    texts = [np.unique(rows.labels[k], return_inverse=True)[1] for k in PLACES if k in rows.labels]
    return np.column_stack([rows.pose_id, *texts])


def _deviations_from_group(values: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, d) deviations from the middle of their group, and each one's degrees of freedom.

    They are NaN where a channel was not measured, or only once in the group.
    """
    scatter, share = np.full(values.shape, np.nan), np.full(values.shape, np.nan)
    for g in np.unique(group):
        rows = values[group == g]
        count = np.isfinite(rows).sum(axis=0)
        again = count > 1
        if not again.any():
            continue
        middle = np.where(count > 2, channel_medians(rows), channel_means(rows))
        scatter[group == g] = np.where(again, rows - middle, np.nan)
        freedom = np.where(again, (count - 1) / np.maximum(count, 1), np.nan)
        share[group == g] = np.where(np.isfinite(rows), freedom, np.nan)
    return scatter, share


def noise_from_residual(
    fit: ModelFit, extra: np.ndarray, steps: int = 12
) -> tuple[NoiseEstimate, np.ndarray]:
    """Estimate the noise as the residual when everything in the library is fitted at once.

    It is the noise of highest evidence: each channel counts its rows less the part that the fit
    explains (trace of the hat matrix; MacKay 1992, Neural Comput. 4).  Channels of one sensor share
    their noise, or one of them could be fitted exactly and then outweigh all.  With more columns
    than equations all could be, so the size of the library's effects is estimated too. And with
    more columns than rows the noise is no smaller than the sightings' own standard deviation, where
    the session has one.

    Args:
        fit: the model so far.
        extra: (N, d, k) prior-scaled columns of every candidate.

    Returns:
        The noise, and the (N,) weights it was found with.
    """
    columns = np.concatenate([fit.columns * prior_widths(fit.slots), extra], axis=-1)
    y = (fit.residual + fit.columns @ fit.model.values)[..., None]
    channels = np.ascontiguousarray(np.moveaxis(np.concatenate([columns, y], -1), 1, 0))
    weights, used = np.ones(len(fit.weights)), np.zeros(0)
    uneven, held = fit.session.uneven(fit.session.claimed_sigma), fit.session.measured
    sigma, size = fit.sigma, 1.0
    added = np.arange(columns.shape[-1]) >= fit.columns.shape[-1]
    ends = np.cumsum([len(block.channels) for block in fit.session.blocks])[:-1]
    few = len(added) > (weights > 0).sum() * len(sigma)
    for _ in range(MOST_STEPS if few else steps):
        if not np.array_equal(weights, used):
            rows = channels[:, weights > 0] * np.sqrt(weights[weights > 0])[:, None]
            products, used = np.stack([part.T @ part for part in rows]), weights
        scale = np.where(added, size, 1.0)
        white = products / sigma[:, None, None] ** 2
        gram = white[:, :-1, :-1] * np.outer(scale, scale)
        posterior = linear.solve_products(gram.sum(0), scale * white[:, :-1, -1].sum(0))
        residual = (y - columns @ (scale * posterior.u)[:, None])[..., 0]
        count = linear.weigh_rows(residual, uneven, held)
        even = residual * np.sqrt(count)[:, None]
        kept = np.where(held, even, np.nan)
        robust = MAD * channel_medians(np.abs(kept[weights > 0]))
        taken = (gram * posterior.covariance).sum(axis=(1, 2))
        rows_held = held[weights > 0].sum(0)
        degrees = np.maximum(rows_held - taken, 1e-9)
        worst = np.abs(kept) / np.maximum(robust * np.sqrt(rows_held / degrees), 1e-9)
        weights = count * (np.nan_to_num(worst).max(axis=1) <= OUTLIER)
        square = (even[weights > 0] ** 2).sum(0)
        parts = np.split(_likeliest_noise(square, degrees) ** 2, ends)
        alike = np.concatenate([np.full(len(part), np.median(part)) for part in parts])
        new = _likeliest_noise(square + BEFOREHAND * alike, degrees + BEFOREHAND)
        new = np.where(held[weights > 0].any(0), new, np.inf)
        shrunk = 1.0
        if few:  # size of the library's effects in their priors' standard deviations
            determined = added.sum() - np.trace(posterior.covariance[np.ix_(added, added)])
            square_sum = (posterior.u[added] ** 2).sum()
            shrunk = float(np.sqrt(square_sum / max(determined, 1e-9)))
        done = np.all((new == sigma) | (np.abs(new - sigma) < 0.01 * sigma))
        sigma, size = np.maximum(new, 1e-7), float(np.clip(size * shrunk, 1e-4, 1.0))
        if done and abs(shrunk - 1.0) < 0.05:
            break
    if columns.shape[-1] > (weights > 0).sum():
        claimed = fit.session.claimed_sigma
        sigma = np.maximum(sigma, [claimed.get(name, 0.0) for name in fit.session.channels])
    rho = lag_correlation(even / sigma, weights, held)
    return NoiseEstimate(sigma, "residual", rho, float(np.max(degrees))), weights


def _likeliest_noise(square: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    """Return (d,) the most probable noise by a sum of squares and its degrees of freedom.

    Beforehand its logarithm is normal about that of `USUAL`.  Few equations can be fitted exactly,
    and would have no noise at all; many outweigh what was thought beforehand.
    """
    price, middle = 1.0 / math.log(_WITHIN) ** 2, math.log(USUAL)
    log_sigma = np.minimum(0.5 * np.log(np.maximum(square, 1e-30) / degrees), middle)
    for _ in range(NEWTON_STEPS):  # from below: they never overshoot
        pull = square * np.exp(-2.0 * log_sigma)
        slope = degrees - pull + price * (log_sigma - middle)
        log_sigma = log_sigma - slope / (2.0 * pull + price)
    return np.asarray(np.exp(log_sigma))


def limit_by_repeats(repeats: NoiseEstimate, residual: NoiseEstimate) -> NoiseEstimate:
    """Return the noise from the residual, but no more than the repeats allow.

    A few dozen repeats tell sigma only to a factor of 1.5, too rough to weigh evidence with. The
    rich fit tells it to a few percent, unless it lacks something: then its noise is more than the
    repeats allow (F distribution, `ALLOWED`), and the most that they allow is taken.  Repeats that
    scatter more (temperature, time) do not count.
    """
    limit = np.sqrt(fdtri(repeats.degrees, max(residual.degrees, 1.0), ALLOWED))
    most = repeats.sigma / limit
    lack = most < residual.sigma
    sigma = np.where(lack, most, residual.sigma)
    source = "repeats" if lack.any() else "residual"
    return NoiseEstimate(sigma, source, residual.rho, residual.degrees)


def lag_correlation(white: np.ndarray, weights: np.ndarray, measured: np.ndarray) -> float:
    """Return the correlation of successive inlier rows, 0 unless beyond 4 standard errors."""
    kept = white[weights > 0]
    if len(kept) < 20:
        return 0.0
    size = int(measured[weights > 0].sum())
    rho = float((kept[1:] * kept[:-1]).sum() / (kept**2).sum())
    return rho if abs(rho) > 4 / np.sqrt(size) and abs(rho) > 0.1 else 0.0


def rows_as_one(rho: float) -> float:
    """Return how many rows count as one, where noise goes together from row to row by `rho`."""
    return (1.0 + rho) / (1.0 - rho)
