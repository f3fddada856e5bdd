"""Estimates the noise of the measurements, from repeats and from a fit with all candidates."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import expit, fdtri, log_ndtr, logsumexp, softmax

from longarm_comp.core.calibration import linear
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.linear import MAD, OUTLIER, channel_means, channel_medians
from longarm_comp.core.calibration.model_fit import ModelFit, prior_widths
from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.data.measurement import make_equations
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.model.model import Model

ENOUGH_REPEATS = 15
"""Smallest number of degrees of freedom of repeats whose scatter is trusted."""
ALLOWED = 1e-3
"""Probability that the noise of an axis exceeds by chance the limit that its repeats set."""
RIGHT_WITHIN = 2.0
"""Factor by which a sensor's stated noise may be wrong: one standard deviation."""
EXCESS_WITHIN = 1e3
"""Largest scatter by other causes than the sensor, over the smallest that matters."""
NEWTON_STEPS = 10
STEPS, MOST_STEPS = 12, 60
"""Largest number of steps to estimate the noise, and the size of the library's effects with it."""
LEAST_ROWS = 12
"""Smallest number of rows to judge the shape of their scatter: two covariances of six numbers."""
SHARES = np.linspace(0.0, 0.95, 20)
"""Shares of the arm in the scatter that are tried; all have the same prior probability."""
TURNING = math.log(20.0)
"""Prior log odds that all scatter is the sensor's: another cause is in about one session of 20."""
APART = 4.5
"""Distance of two groups of rows, over their scatter, from which hardly a row lies between them.

The halves of a uniform distribution, as of a coarse display, are 3.5 apart.
"""
EM_STEPS = 30
USUAL = 3e-4
"""Prior median of the noise of a sighting, m or rad.

A factor of `_WITHIN` is one standard deviation.
"""
_WITHIN = 10.0
PLACES = ("group", "marker", *dict.fromkeys(k.label for k in KINDS.values() if k.label))
"""Text columns that distinguish the measured targets, and the places they are measured from."""


@dataclass(frozen=True)
class NoiseEstimate:
    """An estimate of the noise of a session.

    Attributes:
        sigma: (d,) standard deviation per channel, m or rad.
        source: ``repeats`` or ``residual``.
        rho: correlation of the noise from one row to the next; 0 if it is insignificant.
        degrees: degrees of freedom of a channel: the fewest of those with enough repeats, or the
            most by a residual.
    """

    sigma: np.ndarray
    source: str
    rho: float
    degrees: float


def noise_from_repeats(model: Model, session: Session) -> NoiseEstimate | None:
    """Estimate the noise from repeats of a pose that was reached from the same side.

    Only differences within a pose count, so the result hardly depends on the model.  Repeats from
    different sides also differ by hysteresis, so each side is a group of its own, as is each
    anchor, marker and base.  Deviations beyond `OUTLIER` robust standard deviations are left out.
    A row that is equal to another one to the last digit is a copy, and no second measurement.

    Returns:
        The noise, infinite in channels with too few repeats; None if all have too few.
    """
    size, degrees = repeat_scatter(model, session)
    enough = degrees >= ENOUGH_REPEATS
    if not enough.any():
        return None
    sigma = np.where(enough, np.maximum(size, 1e-7), np.inf)
    return NoiseEstimate(sigma, "repeats", 0.0, float(degrees[enough].min()))


def repeat_scatter(model: Model, session: Session) -> tuple[np.ndarray, np.ndarray]:
    """Return the standard deviation (d,) of repeats, m or rad, and its degrees of freedom (d,).

    Repeats are defined as in `noise_from_repeats`.
    """
    seen = session.take(session.seen)
    keys = np.column_stack([number_sightings(seen), seen.approach])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    if seen.plain:
        values = seen.xyz
    else:
        residual = make_equations(model, seen, ()).residual
        # In a touch the joints are the reading, so the same joints again are no second reading;
        # nor is a second one of an encoder, which repeats its own error
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
    freedom = np.sqrt(np.maximum(channel_means(share), 1e-9))
    robust = MAD * channel_medians(np.abs(scatter)) / freedom
    kept = (np.nan_to_num(np.abs(scatter)) <= OUTLIER * np.maximum(robust, 1e-9)).all(axis=1)
    degrees = np.nansum(share[kept], axis=0)
    size = np.sqrt(np.nansum(scatter[kept] ** 2, axis=0) / np.maximum(degrees, 1e-9))
    return size, degrees


class SensorShare(NamedTuple):
    """The share of the sensor in the variance of the residual.

    Attributes:
        share: its expected value.
        whole: probability that all of the residual is the sensor's.
        sign: in words, what shows other causes.
    """

    share: float
    whole: float
    sign: str


def share_of_sensor(fit: ModelFit) -> SensorShare:
    """Estimate the share of the sensor in the variance of the residual.

    Either all of the residual is the sensor's, or a cause that no input shows adds to it: two
    unrecorded tools, a loose tool, an arm that does not return.  The stated noise of the rows and
    the shape of the scatter are judged separately, and the smallest share is returned.
    """
    found, kept = [_share_by_statement(fit)], (fit.weights > 0) & fit.has_point
    if kept.sum() >= LEAST_ROWS and fit.session.blocks[0].kind == "position":
        root = np.sqrt(fit.weights[kept])[:, None]
        residual, by_tip = fit.residual[kept][:, :3] * root, fit.residual_by_tip[kept] * root
        found.append(_share_by_shape(residual, by_tip))
        zeros = FitColumns(fit).prior_columns(JointZero.for_arm(fit.model.arm))[kept, :3]
        found.append(_share_by_joints(residual, zeros))
        found += map(_share_by_groups, (residual, by_tip))
    return min(found)


def _share_by_shape(residual: np.ndarray, by_tip: np.ndarray) -> SensorShare:
    """Estimate the sensor's share by the shape of the scatter.

    The residual (N, 3), m, is normal with a constant covariance either in the frame of the
    measurements, as for a sensor, or in the frame of the tip (`by_tip`). In the latter case the
    sensor's part is the part that is equal in all directions.
    """
    logs, spread = [], np.zeros(3)
    for each in (residual, by_tip):
        spread = np.maximum(np.linalg.eigvalsh(each.T @ each / len(each)), 1e-30)
        logs.append(-0.5 * len(each) * float(np.log(spread).sum()))
    whole = float(expit(TURNING + logs[0] - logs[1]))
    share = whole + (1.0 - whole) * float(3.0 * spread[0] / spread.sum())
    return SensorShare(share, whole, "turns with the tool, as no sensor's noise does")


def _share_by_joints(residual: np.ndarray, columns: np.ndarray) -> SensorShare:
    """Estimate the sensor's share by the postures: scatter of joints grows with their levers.

    The residual is either normal with a constant covariance, as for a sensor. Or it is the sum of
    sensor noise, equal in all directions, and of joints that scatter by the same number of units.
    All shares have the same prior probability.

    Args:
        residual: (N, 3) m.
        columns: (N, 3, n) displacement of the tip by a unit of each joint, m.
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
    """Estimate the sensor's share by groups of rows: the noise of a sensor has one centre.

    The residual (N, 3), m, is normal about one centre, or about two centres with the same
    covariance. In the latter case the sensor's part is the scatter about them.  The two centres
    must be far apart (`APART`), because noise that is not normal may look like two close groups.
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
    """Estimate the sensor's share by the noise that the rows state; 1 if they state none.

    The noise of causes other than the sensor may be of any size.
    """
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
    """Number each row's pose and texts in `PLACES`, (N, k): rows that repeat one sighting agree."""
    texts = [np.unique(rows.labels[k], return_inverse=True)[1] for k in PLACES if k in rows.labels]
    return np.column_stack([rows.pose_id, *texts])


def _deviations_from_group(values: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the deviations (N, d) from the middle of each row's group, and each value's freedom.

    Both are NaN where values (N, d) are, the deviations also if a group has no second value.
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


def noise_from_residual(fit: ModelFit, extra: np.ndarray) -> tuple[NoiseEstimate, np.ndarray]:
    """Estimate the noise from the residual of a linear fit with all candidates at once.

    It is the noise of highest evidence: the degrees of freedom of a channel are its rows less the
    parameters that it determines (trace of the hat matrix; MacKay 1992, Neural Comput. 4).
    Channels of one sensor are assumed to have similar noise, because otherwise one of them might be
    fitted exactly and outweigh all others.  With more columns than equations all might be fitted
    exactly, so the size of the candidates' effects is estimated too.  With more columns than rows
    the noise is at least the standard deviation that the rows state.

    Args:
        fit: the model so far.
        extra: (N, d, k) prior-scaled columns of all candidates.

    Returns:
        The noise, and the weights (N,) of the rows with which it was found.
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
    for _ in range(MOST_STEPS if few else STEPS):
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
        new = _likeliest_noise(square + linear.BEFOREHAND * alike, degrees + linear.BEFOREHAND)
        new = np.where(held[weights > 0].any(0), new, np.inf)
        shrunk = 1.0
        if few:  # size of the library's effects in their priors' standard deviations
            determined = added.sum() - np.trace(posterior.covariance[np.ix_(added, added)])
            square_sum = (posterior.u[added] ** 2).sum()
            shrunk = float(np.sqrt(square_sum / max(determined, 1e-9)))
        done = np.allclose(new, sigma, rtol=0.01, atol=0.0)  # a channel without rows stays infinite
        sigma, size = np.maximum(new, 1e-7), float(np.clip(size * shrunk, 1e-4, 1.0))
        if done and abs(shrunk - 1.0) < 0.05:
            break
    if columns.shape[-1] > (weights > 0).sum():
        claimed = fit.session.claimed_sigma
        sigma = np.maximum(sigma, [claimed.get(name, 0.0) for name in fit.session.channels])
    rho = lag_correlation(even / sigma, weights, held)
    return NoiseEstimate(sigma, "residual", rho, float(np.max(degrees))), weights


def _likeliest_noise(square: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    """Return the most probable noise (d,), given sums of squares and their degrees of freedom.

    The prior of its logarithm is normal about that of `USUAL`.  It matters only for few equations,
    which might be fitted exactly and then seem to have no noise.

    Args:
        square: (d,) sum of the squared residuals, m^2 or rad^2.
        degrees: (d,) degrees of freedom.
    """
    price, middle = 1.0 / math.log(_WITHIN) ** 2, math.log(USUAL)
    log_sigma = np.minimum(0.5 * np.log(np.maximum(square, 1e-30) / degrees), middle)
    for _ in range(NEWTON_STEPS):  # from below: they never overshoot
        pull = square * np.exp(-2.0 * log_sigma)
        slope = degrees - pull + price * (log_sigma - middle)
        log_sigma = log_sigma - slope / (2.0 * pull + price)
    return np.asarray(np.exp(log_sigma))


def limit_by_repeats(repeats: NoiseEstimate, residual: NoiseEstimate) -> NoiseEstimate:
    """Return the noise from the residual, limited by the noise from repeats.

    A few dozen repeats determine the noise only to a factor of 1.5, which is too rough for an
    evidence. The fit with all candidates determines it to a few percent, unless a cause is missing.
    Then its noise exceeds the limit that the repeats allow (F distribution, `ALLOWED`), and the
    limit is returned.  If repeats scatter more than the residual (temperature, time), they have
    no influence.
    """
    limit = np.sqrt(fdtri(repeats.degrees, max(residual.degrees, 1.0), ALLOWED))
    most = repeats.sigma / limit
    lack = most < residual.sigma
    sigma = np.where(lack, most, residual.sigma)
    source = "repeats" if lack.any() else "residual"
    return NoiseEstimate(sigma, source, residual.rho, residual.degrees)


def lag_correlation(white: np.ndarray, weights: np.ndarray, measured: np.ndarray) -> float:
    """Return the correlation of the noise of successive inliers.

    It is 0 for fewer than 20 inliers, and unless it is above 0.1 and 4 standard errors in size.

    Args:
        white: (N, d) residual in units of the noise.
        weights: (N,) weights of the rows; 0 for an outlier.
        measured: (N, d) True for the channels that a row measured.
    """
    kept = white[weights > 0]
    if len(kept) < 20:
        return 0.0
    size = int(measured[weights > 0].sum())
    rho = float((kept[1:] * kept[:-1]).sum() / (kept**2).sum())
    return rho if abs(rho) > 4 / np.sqrt(size) and abs(rho) > 0.1 else 0.0


def rows_as_one(rho: float) -> float:
    """Return the number of rows that count as one if successive rows have the correlation `rho`."""
    return (1.0 + rho) / (1.0 - rho)
