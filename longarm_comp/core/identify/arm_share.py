"""How much of what a fit leaves is the arm's and not the measurement's: noise is not alike.

At poses that are alike the arm does alike, so what it does and the model lacks looks as if the
parameters changed with the joints.  The residual is white noise and such a Gaussian process; their
shares are weighed by the evidence of the rows, what the fit took off them projected out (restricted
likelihood; Patterson and Thompson 1971, Biometrika 58), and by repeats, however few.
"""

from __future__ import annotations

import numpy as np

from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.noise import repeat_scatter

ROWS = 200
"""Rows that it is judged by, spread over the session: three axes make a matrix of 600."""
WIDTHS = (0.25, 0.5, 1.0)
"""Over which part of an input's range the process is alike."""
SHARES = np.linspace(0.0, 0.95, 20)


def arm_share(fit: ModelFit) -> float:
    """Expected share of the residual's variance, 0 to 1; all shares alike beforehand."""
    kept = np.flatnonzero((fit.weights > 0) & fit.pointed)
    kept = kept[np.unique(np.linspace(0, len(kept) - 1, ROWS).round().astype(int))]
    residual = fit.residual[kept][:, :3] * np.sqrt(fit.weights[kept])[:, None]
    size = np.maximum(np.sqrt((residual**2).mean(axis=0)), 1e-12)
    scale = np.array([slot.parameter.prior for slot in fit.slots])
    columns = fit.columns[kept][:, :3] * scale / size[:, None]
    flat = columns.reshape(3 * len(kept), -1)
    u, s, _ = np.linalg.svd(flat)
    free = u[:, int((s > 1e-8 * s.max(initial=1e-300)).sum()) :]
    inputs = _inputs(fit)[kept]
    if free.shape[1] < 2 or not inputs.shape[1]:
        return 0.0
    y = free.T @ (residual / size).reshape(-1)
    alike = (flat @ flat.T).reshape(len(kept), 3, len(kept), 3)
    kernels = (alike * kernel[:, None, :, None] for kernel in _kernels(inputs))
    log = np.array([_evidence(free, y, kernel.reshape(len(flat), -1)) for kernel in kernels])
    log += _by_repeats(fit, float((size**2).sum()))
    weight = np.exp(log - log.max()).sum(axis=0)
    return float(weight @ SHARES / weight.sum())


def _inputs(fit: ModelFit) -> np.ndarray:
    """(N, k) joints, sides of arrival and recorded numbers, those that change, in their ranges."""
    session = fit.session
    columns = [session.q, session.approach, *(v[:, None] for v in session.columns.values())]
    whole = np.concatenate([np.asarray(c, float) for c in columns], axis=1)
    span = np.ptp(whole, axis=0)
    return np.asarray(whole[:, span > 0] / span[span > 0])


def _kernels(x: np.ndarray) -> list[np.ndarray]:
    """(N, N) each: functions of one input at a time, and of all together."""
    apart = (x[:, None] - x[None]) ** 2
    made = []
    for width in WIDTHS:
        each = np.exp(-0.5 * apart / width**2)
        made += [each.mean(axis=2), each.prod(axis=2)]
    return made


def _evidence(free: np.ndarray, y: np.ndarray, process: np.ndarray) -> np.ndarray:
    """(shares,) log likelihood of the projected residual, its size maximised."""
    values, vectors = np.linalg.eigh(free.T @ process @ free)
    values = np.maximum(values, 0.0)
    z = vectors.T @ y
    variance = 1.0 + SHARES[:, None] * (values / max(values.mean(), 1e-300) - 1.0)
    size = (z**2 / variance).mean(axis=1)
    return np.asarray(-0.5 * (len(y) * np.log(size) + np.log(variance).sum(axis=1)))


def _by_repeats(fit: ModelFit, whole: float) -> np.ndarray:
    """(shares,) log likelihood of the scatter of repeats, m^2, where `whole` is arm and noise."""
    sigma, degrees = repeat_scatter(fit.model, fit.session)
    count = float(np.nansum(degrees[:3]))
    if not count or fit.session.blocks[0].kind != "position":
        return np.zeros(len(SHARES))
    noise = (1.0 - SHARES) * whole / 3.0
    square = float(np.nansum(degrees[:3] * np.nan_to_num(sigma[:3]) ** 2))
    return np.asarray(-0.5 * (count * np.log(noise) + square / noise))
