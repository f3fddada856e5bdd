"""Further tests for structure beside the F test: held-out rows, rows left out, scatter."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import bdtrc, fdtrc, gammaincinv

from longarm_comp.core.calibration.linear import mark_inliers, solve_posterior
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.noise import rows_as_one, share_of_sensor
from longarm_comp.core.data.measurement import compute_unit_lengths, make_equations
from longarm_comp.core.data.session import Session
from longarm_comp.core.data.set_aside import SetAside
from longarm_comp.core.identify.structure import Structure, smallest_that_matters

OFF = 0.5
"""Smallest excess over the noise that counts, as a share of the noise, which is known to a tenth.
"""


def with_held_out(structure: Structure, held_out: Sequence[tuple[ModelFit, Session]]) -> Structure:
    """Return the structure, also flagged if only the held-out poses show some.

    The part that errors of the parameters explain is subtracted first. If only noise is left, half
    of the rows exceed its median (chi distribution). A few gross errors do not change this test.

    Args:
        structure: the structure by the fitted rows.
        held_out: fits without some rows, and these rows.
    """
    parts = [_compare_with_noise(fit, rows) for fit, rows in held_out]
    ratio, square = (np.concatenate(each) for each in zip(*parts, strict=True))
    fit = held_out[0][0]
    if structure.flag or not len(ratio):
        return structure
    count = max(round(len(ratio) / rows_as_one(fit.rho)), 1)  # effective number of rows
    above = round(float((ratio > 1.0).mean()) * count)
    p = float(bdtrc(above - 1, count, 0.5))
    expected = np.sqrt(square.mean())
    excess = float(expected * np.sqrt(max(np.median(ratio) ** 2 - 1.0, 0.0)))
    least = max(OFF * float(expected), smallest_that_matters(fit))
    sign = "shows in the held-out poses"
    return structure.add_test(p, excess, least, "held-out poses", sign)


def _compare_with_noise(fit: ModelFit, rows: Session) -> tuple[np.ndarray, np.ndarray]:
    """Compare the errors at rows that were not fitted with their noise.

    Returns (M,) size of the error divided by the median that noise has, and (M,) variance of the
    noise, m^2.
    """
    found = make_equations(fit.model, rows)
    known = dict(zip(fit.session.channels, fit.sigma, strict=True))
    sigma = np.array([known.get(name, np.inf) for name in rows.channels])
    held = rows.measured & np.isfinite(sigma)
    noise = np.where(np.isfinite(sigma), sigma, 1.0) * fit.stated_noise_ratio(rows)[:, None]
    some = held.any(axis=1)
    if not some.any():
        return np.zeros(0), np.zeros(0)
    size, ways = np.linalg.eigh(fit.covariance)
    moved = found.columns @ (ways * np.sqrt(np.maximum(size, 0.0)))
    a = (moved * (held / noise)[..., None])[some]
    left = _sizes_left(a, (found.residual * held / noise)[some], held[some])
    ratio = left / np.sqrt(2.0 * gammaincinv(held.sum(axis=1)[some] / 2, 0.5))
    return ratio, ((noise * compute_unit_lengths(fit.model, rows)) ** 2 * held).sum(1)[some]


def with_left_out(structure: Structure, fit: ModelFit) -> Structure:
    """Return the structure, also flagged if the rows that the fit left out have a cause in common.

    Gross errors have no common direction. This is tested by Hotelling's T-squared test of their
    mean, among rows that measure the same channels, as it is, in the axes of the tip (another
    reflector on the tool), and turned with the side from which a joint arrived; the scatter is
    taken as at least the noise. Nor do gross errors share a trait (`SetAside`).
    """
    known = np.isfinite(fit.sigma) & fit.session.measured
    left_out, tried = np.flatnonzero(fit.weights == 0), list[tuple[float, float, str]]()
    for held in np.unique(known[left_out], axis=0):
        rows = left_out[(known[left_out] == held).all(axis=1)]
        white = fit.residual[rows][:, held] / fit.sigma[held]
        metres = (fit.sigma * fit.metres)[held]
        sides = (side for side in fit.session.approach[rows].T if len(np.unique(side)) > 1)
        ways = [((turned[:, None] * white)[turned != 0], metres, "") for turned in sides]
        ways.append((white, metres, ""))
        if fit.session.blocks[0].kind == "position" and held[:3].all():
            noise = np.full(3, np.sqrt((fit.sigma[:3] ** 2).mean()))
            ways.append((fit.residual_by_tip[rows] / noise, noise, " in the axes of the tool"))
        for left, unit, how in ways:
            if 0 < left.shape[1] < len(left):
                size = float(np.linalg.norm(left.mean(0) * unit))
                tried.append((_test_mean(left), size, f"{len(left)} rows{how}"))
    least = smallest_that_matters(fit)
    if tried:
        p, size, said = min(tried)
        sign = f"is shared by {said}, which no fit explains"
        structure = structure.add_test(p * len(tried), size, least, "rows left out", sign)
    for trait in SetAside.of(fit.session, fit.weights == 0).shared_by[:1]:
        moved = np.where(known, fit.residual, 0.0)[left_out] * fit.metres
        size = float(np.sqrt((moved**2).sum(axis=1).mean()))
        sign = f"is in the rows that no fit explains, which share {trait}"
        structure = structure.add_test(trait.p_value, size, least, trait.input, sign)
    return structure


def _test_mean(white: np.ndarray) -> float:
    """Return the p-value of the mean of rows (count, width), in units of their noise, being 0."""
    count, width = white.shape
    scatter = np.cov(white, rowvar=False).reshape(width, width) + np.eye(width)
    squared = count * white.mean(0) @ np.linalg.solve(scatter, white.mean(0))
    ratio = (count - width) / (width * (count - 1)) * squared
    return float(fdtrc(width, count - width, ratio))


def with_scatter(structure: Structure, fit: ModelFit) -> Structure:
    """Return the structure, also flagged if the scatter cannot be that of the sensor alone."""
    sensor, least = share_of_sensor(fit), smallest_that_matters(fit)
    size = float(np.linalg.norm(fit.noise_m)) * math.sqrt(1.0 - sensor.share)
    chance = 1.0 - sensor.whole
    return structure.add_test(sensor.whole, size, least, "scatter", sensor.sign, chance)


def _sizes_left(a: np.ndarray, y: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the (N,) size of the residual of each row, standardised by its own variance.

    Parameters with unit normal priors are fitted to the rows without outliers. Their columns
    a (N, d, p) and the data y (N, d) are in units of the noise.
    """
    kept = mark_inliers(y, measured)[:, None]
    shared = (kept[..., None] * a).reshape(-1, a.shape[-1])
    found = solve_posterior(shared, (kept * y).ravel())
    leverage = np.einsum("nip,pq,niq->ni", a, found.covariance, a, optimize=True)
    variance = np.where(kept > 0, np.maximum(1.0 - leverage, 1e-12), 1.0 + leverage)
    return np.linalg.norm((y - a @ found.u) / np.sqrt(variance), axis=1)
