"""The record of how good a fitted model is where it was not fitted, which every command reads.

The posterior of a fit is too sure where the model's form is not quite right: what it lacks is
alike from row to row, so many rows count as few.  Therefore rows are left out, a part of one
joint's range at a time and in small random parts, and the error that the fit would then make at
them is computed from the design (no fit is repeated).  An error that no parameter explains is added
so that 90 % of the rows left out lie inside the stated radius (split conformal; Vovk 2015, Ann.
Math. Artif. Intell. 74).  Where that is more than rows amid the others err, the error grows with
the distance instead: the parameters are then known as by fewer rows.

Not all of a fit's residual is noise.  At similar poses the arm behaves alike, so a fault that the
model lacks looks as if the parameters changed with the joints.  The residual is white noise and
such a Gaussian process; their shares are weighed by the evidence of the rows, with the part that
the fit explains projected out (restricted likelihood; Patterson and Thompson 1971, Biometrika 58),
and by repeats, however few.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import CLOCK, ORDER, is_told
from longarm_comp.core.calibration.linear import whiten
from longarm_comp.core.calibration.model_fit import ModelFit, priors
from longarm_comp.core.calibration.noise import repeat_scatter
from longarm_comp.core.data.commanded import moved_by_measuring, moved_with_time
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.uncertainty import LEVEL, ModelUncertainty, factor_of, sizes

FRAME = 2.0
"""Standard deviations of what the measuring side did, that a frame may be off by: the ends of a
steady drift lie 1.7 from its mean, those of one that dies away farther."""
PARTS, SMALL = 4, 20
"""Parts of a joint's range, and random parts, that are left out one at a time; a 90 % radius takes
as many rows at least."""
MOST = 1000
"""Rows that are left out, at most, evenly over the session: they tell 90 % to one percent."""
TRIED = 12
"""Numbers of rows that may count as one."""
AMID = 0.95
"""Of the rows amid the others, the share that is inside at most.  Rows that nobody fitted may err
more than these: at 0.9, 55 % of WAM's are inside instead of 80 %."""
HALVINGS = 30
"""Of a range: to nine digits."""


def with_uncertainty(fit: ModelFit) -> Model:
    """Return the fitted model with the record of how good it is, and the end of its session."""
    record = uncertainty(fit)
    return dataclasses.replace(fit.model, uncertainty=record, ended_s=fit.session.ended_s)


def uncertainty(fit: ModelFit) -> ModelUncertainty:
    """Make the record of a fit from its errors at rows that are left out of it."""
    kept, alike = fit.weights > 0, 1.0
    left_out = LeftOut.of(fit)
    if left_out is None:
        lengths = fit.noise_m[fit.metres > 0]  # no position tells what a row leaves
        noise, structure = np.eye(3) * (lengths**2).sum() / max(len(lengths), 1), np.zeros((3, 3))
    else:
        spread = fit.residual[kept & fit.pointed][:, :3]
        noise = (1.0 - arm_share(fit)) * np.diag((spread**2).mean(axis=0))
        alike, structure = left_out.explain(noise)
    # The frame in which targets are taken: the mean of what the measuring side moved the rows by,
    # or that of the session's start, where that of any row may be meant; and that of the end, where
    # the base moved, or seemed to
    rows = fit.session.take(kept)
    moved, since = moved_by_measuring(fit.model, rows), moved_with_time(fit.model, rows)
    moved = moved - fit.model.frame_shift if len(moved) else moved
    frames = (FRAME * each for each in (moved, since) if len(each))
    frame = np.sum([np.zeros((3, 3)), *(off.T @ off / len(off) for off in frames)], axis=0)
    # Lowest and highest of what a command is told, but of time
    circumstances, payload = {}, fit.model.arm.payload
    if payload is not None:  # as declared where the rows do not say it
        circumstances["payload_kg"] = (payload.mass_kg, payload.mass_kg)
    for name, column in fit.session.columns.items():
        values = np.asarray(column, dtype=float)[kept]
        if is_told(name) and name not in (CLOCK, ORDER) and np.isfinite(values).any():
            circumstances[name] = (float(np.nanmin(values)), float(np.nanmax(values)))
    record = ModelUncertainty(
        tuple(slot.identity for slot in fit.slots),
        math.sqrt(alike) * factor_of(fit.covariance),
        structure,
        noise,
        largest_m=0.0,
        rows=int(kept.sum()),
        frame=frame,
        circumstances=circumstances,
    )
    pointed = fit.pointed & kept
    if not pointed.any():
        return record
    arm_side = [k for k, slot in enumerate(fit.slots) if isinstance(slot.owner, Effect)]
    columns = fit.columns[pointed][:, :3, arm_side]
    covariance = record.carry_to_tip(columns, [fit.slots[k].identity for k in arm_side])
    expected = sizes(covariance + record.structure)[0]
    return dataclasses.replace(record, largest_m=float(expected.max()))


@dataclass(frozen=True, eq=False)
class LeftOut:
    """The rows that are left out of a fit, each several times.

    Attributes:
        error: (M, 3) m, measured - predicted without them.
        covariance: (M, 3, 3) m^2 by the parameters fitted without them.
        count: (M,) weight of each; one row's weights sum to 1.
        amid: (M,) whether a row was left out amid the others, not with all that are near it.
    """

    error: np.ndarray
    covariance: np.ndarray
    count: np.ndarray
    amid: np.ndarray

    @classmethod
    def of(cls, fit: ModelFit) -> LeftOut | None:
        """Leave rows out of a fit to positions or touches; None where too few rows hold one.

        A touched point is not known, so its rows are judged against their mean.
        """
        kept = np.flatnonzero((fit.weights > 0) & fit.pointed)
        if len(kept) < SMALL:
            return None
        touched = fit.session.labels["touch"][kept] if not fit.session.located.any() else None
        both = np.concatenate([fit.columns * priors(fit.slots), fit.residual[..., None]], axis=-1)
        white = whiten(both, fit.weights, fit.sigma, 0.0, fit.session.measured)
        whole = white.reshape((fit.weights > 0).sum(), fit.width, -1)
        here = np.searchsorted(np.flatnonzero(fit.weights > 0), kept)
        gram = np.einsum("ncp,ncq->pq", whole[..., :-1], whole[..., :-1])
        gram += np.eye(len(gram))
        length = fit.sigma[:3] / np.sqrt(fit.weights[kept])[:, None]
        judged = np.unique(np.linspace(0, len(kept) - 1, MOST).round().astype(int))
        errors, covariances, counts, amid = [], [], [], []
        places = None
        if touched is not None:  # points of known distances are one tool's: one place
            places = touched.copy()
            for first, second, *_ in fit.session.touch_distances:
                places[places == second] = first
        for division, share, near in _divisions(fit.session.q[kept], places):
            for part in np.unique(division):
                out = division == part
                a = whole[here[out]]
                flat = a.reshape(-1, a.shape[-1])
                inverse = np.linalg.inv(gram - flat[:, :-1].T @ flat[:, :-1])
                shift = inverse @ (flat[:, :-1].T @ flat[:, -1])
                rows = a[:, :3] * length[out][..., None]
                mine = np.isin(np.flatnonzero(out), judged)
                if touched is not None:
                    rows, alone = about_the_mean(rows, touched[out])
                    mine &= ~alone
                moved = rows[mine, :, :-1]
                errors.append(rows[mine, :, -1] + moved @ shift)
                covariances.append(moved @ inverse @ np.swapaxes(moved, 1, 2))
                counts.append(np.full(mine.sum(), share))
                amid.append(np.full(mine.sum(), near))
        return cls(*(np.concatenate(each) for each in (errors, covariances, counts, amid)))

    def explain(self, noise: np.ndarray) -> tuple[float, np.ndarray]:
        """Find the least errors that bring 90 % of the rows inside.

        An error that no parameter explains is the same everywhere, and no larger than rows amid the
        others err.  Where it would be more than nearly all of these err, they contradict it: then
        the parameters are known less, because the rows err alike and many of them count as one.

        Args:
            noise: (3, 3) m^2, of the measurement.

        Returns:
            How many rows count as one, and the further covariance (3, 3), m^2.
        """
        amid = self.amid if self.amid.any() else ~self.amid
        size, tried = np.linalg.norm(self.error, axis=1)[amid], []
        for alike in np.geomspace(1.0, max(len(self.error), 2), TRIED).tolist():
            structure, enough = self._structure(noise, alike, float(size.max()))
            radius = sizes(alike * self.covariance[amid] + noise + structure)[1]
            if enough and (size <= radius).mean() <= AMID:
                return alike, structure
            tried.append((float(np.median(radius)) if enough else math.inf, alike, structure))
        best = min(reversed(tried), key=lambda one: one[0])  # the last, where none is enough
        return best[1:]

    def _structure(
        self, noise: np.ndarray, alike: float, largest: float
    ) -> tuple[np.ndarray, bool]:
        """Find the least further covariance (3, 3) m^2 that brings 90 % of the rows inside.

        Its shape is that of the errors, its size at most `largest`, m, and whether that is enough
        is returned, too.
        """
        shape = np.einsum("n,ni,nj->ij", self.count, self.error, self.error)
        shape /= np.trace(shape) or 1.0
        size = np.linalg.norm(self.error, axis=1)
        wanted = LEVEL * (self.count.sum() + 1.0)
        low, high, enough = 0.0, largest**2, False
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            inside = size <= sizes(alike * self.covariance + noise + middle * shape)[1]
            reached = bool(self.count @ inside >= wanted)
            low, high, enough = (low, middle, True) if reached else (middle, high, enough)
        return high * shape, enough


def about_the_mean(rows: np.ndarray, touched: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Subtract from rows (N, ...) the mean of those that touched the same point.

    They are scaled so that independent noise keeps its variance.

    Returns:
        The rows; (N,) whether a row is the only one that touched its point.
    """
    _, which, count = np.unique(touched, return_inverse=True, return_counts=True)
    sums = np.zeros((len(count), *rows.shape[1:]))
    np.add.at(sums, which, rows)
    beside = (...,) + (None,) * (rows.ndim - 1)
    kept = np.maximum(1.0 - 1.0 / count, 0.5)[which][beside]
    return (rows - (sums / count[beside])[which]) / np.sqrt(kept), count[which] == 1


def _divisions(
    q: np.ndarray, places: np.ndarray | None = None
) -> Iterator[tuple[np.ndarray, float, bool]]:
    """Yield divisions of the rows into parts (N,) to leave out, a row's weight in each division,
    and whether the parts lie amid the other rows.

    Half of the weight is with new places, half with rows amid the others, as targets are.  Where
    points were touched, these are the places.
    """
    if places is not None and len(np.unique(places)) > 1:
        yield np.unique(places, return_inverse=True)[1], 1.0, False
        return
    moving = [q[:, j] for j in range(q.shape[1]) if np.ptp(q[:, j]) > 0.0]
    for values in moving:
        place = np.argsort(np.argsort(values, kind="stable"))
        yield place * PARTS // len(q), 0.5 / len(moving), False
    drawn = np.random.default_rng(0).permutation(len(q))
    yield drawn * min(SMALL, len(q)) // len(q), 0.5 if moving else 1.0, True


ROWS = 200
"""Rows that the arm's share is judged by, spread over the session: three axes make a matrix of 600.
"""
WIDTHS = (0.25, 0.5, 1.0)
"""Over which part of an input's range the process is alike."""
SHARES = np.linspace(0.0, 0.95, 20)
_NOTHING = 1e-8  # of the largest: rounding


def arm_share(fit: ModelFit) -> float:
    """Return the expected share of the arm in the residual's variance, 0 to 1.

    All shares are equally likely beforehand.
    """
    kept = np.flatnonzero((fit.weights > 0) & fit.pointed)
    kept = kept[np.unique(np.linspace(0, len(kept) - 1, ROWS).round().astype(int))]
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
    """Return (shares,) log likelihood of the projected residual, its size maximised."""
    values, vectors = np.linalg.eigh(free.T @ process @ free)
    values = np.maximum(values, 0.0)
    z = vectors.T @ y
    variance = 1.0 + SHARES[:, None] * (values / max(values.mean(), 1e-300) - 1.0)
    size = (z**2 / variance).mean(axis=1)
    return np.asarray(-0.5 * (len(y) * np.log(size) + np.log(variance).sum(axis=1)))


def _log_likelihood_of_repeats(fit: ModelFit, whole: float) -> np.ndarray:
    """Return (shares,) log likelihood of the repeats' scatter; `whole` is arm and noise, m^2."""
    sigma, degrees = repeat_scatter(fit.model, fit.session)
    count = float(np.nansum(degrees[:3]))
    if not count or fit.session.blocks[0].kind != "position":
        return np.zeros(len(SHARES))
    noise = (1.0 - SHARES) * whole / 3.0
    square = float(np.nansum(degrees[:3] * np.nan_to_num(sigma[:3]) ** 2))
    return np.asarray(-0.5 * (count * np.log(noise) + square / noise))
