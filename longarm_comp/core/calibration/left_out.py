"""The errors that a fit would make at rows if these were left out, and what they say of commands.

Each part of the rows is left out in turn, and the error is computed from the design: no fit is
repeated.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.calibration.model_fit import ModelFit, choose_evenly
from longarm_comp.core.model.uncertainty import LEVEL, sizes

PARTS, SMALL = 4, 20
"""Parts of a joint's range, and random parts, that are left out one at a time."""
MOST = 1000
"""Rows that are left out, at most, evenly over the session: they tell 90 % to one percent."""
AMID = (1.0 + LEVEL) / 2.0
"""Of the rows amid the others, the share that is inside at most: halfway from `LEVEL` to all. The
model was chosen on these rows, so that it errs more at others: with `LEVEL` itself, 55 % of WAM's
test rows are inside instead of 80 %."""
HALVINGS = 30
"""Of a range: to nine digits."""


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
        kept = np.flatnonzero((fit.weights > 0) & fit.has_point)
        if len(kept) < 2:
            return None
        touched = fit.session.labels["touch"][kept] if not fit.session.has_position.any() else None
        white = fit.whiten_with_residual(fit.sigma)
        whole = white.reshape((fit.weights > 0).sum(), fit.width, -1)
        here = np.searchsorted(np.flatnonzero(fit.weights > 0), kept)
        gram = np.einsum("ncp,ncq->pq", whole[..., :-1], whole[..., :-1])
        gram += np.eye(len(gram))
        length = fit.sigma[:3] / np.sqrt(fit.weights[kept])[:, None]
        judged = choose_evenly(np.arange(len(kept)), MOST)
        errors, covariances, counts, amid = [], [], [], []
        places = None
        if touched is not None:  # points of known distances are one tool's: one place
            places = touched.copy()
            for first, second, *_ in fit.session.touch_distances:
                places[places == second] = first
        for division, share, near in _divide_rows(fit.session.q[kept], places):
            for part in np.unique(division):
                out = division == part
                a = whole[here[out]]
                flat = a.reshape(-1, a.shape[-1])
                inverse = np.linalg.inv(gram - flat[:, :-1].T @ flat[:, :-1])
                shift = inverse @ (flat[:, :-1].T @ flat[:, -1])
                rows = a[:, :3] * length[out][..., None]
                mine = np.isin(np.flatnonzero(out), judged)
                if touched is not None:
                    rows, alone = subtract_point_means(rows, touched[out])
                    mine &= ~alone
                moved = rows[mine, :, :-1]
                errors.append(rows[mine, :, -1] + moved @ shift)
                covariances.append(moved @ inverse @ np.swapaxes(moved, 1, 2))
                counts.append(np.full(mine.sum(), share))
                amid.append(np.full(mine.sum(), near))
        return cls(*(np.concatenate(each) for each in (errors, covariances, counts, amid)))

    def find_least_errors(self, noise: np.ndarray) -> tuple[float, np.ndarray]:
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
        size, best = np.linalg.norm(self.error, axis=1)[amid], math.inf
        counts = 2.0 ** np.arange(0.0, math.log2(len(self.error)) + 1.0, 0.5)
        alike, structure = float(counts[-1]), size.max() ** 2 / 3.0 * np.eye(3)  # at worst
        for count in counts:
            further = self._find_structure(noise, count, float(size.max()))
            if further is None:  # more than any row amid the others errs
                continue
            radius = sizes(count * self.covariance[amid] + noise + further)[1]
            if np.median(radius) < best:
                best, alike, structure = float(np.median(radius)), float(count), further
            if (size <= radius).mean() <= AMID or not further.any():
                break
        return alike, structure

    def _find_structure(self, noise: np.ndarray, alike: float, largest: float) -> np.ndarray | None:
        """Find the least further covariance (3, 3) m^2 that brings 90 % of the rows inside.

        Its shape is that of the errors; None where its size would be more than `largest`, m.
        """
        shape = np.einsum("n,ni,nj->ij", self.count, self.error, self.error)
        shape /= np.trace(shape) or 1.0
        size = np.linalg.norm(self.error, axis=1)
        wanted = LEVEL * (self.count.sum() + 1.0)

        def holds_enough(square: float) -> bool:
            inside = size <= sizes(alike * self.covariance + noise + square * shape)[1]
            return bool(self.count @ inside >= wanted)

        low, high = 0.0, largest**2
        if holds_enough(low) or not holds_enough(high):
            return 0.0 * shape if holds_enough(low) else None
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if holds_enough(middle) else (middle, high)
        return high * shape


def subtract_point_means(rows: np.ndarray, touched: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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


def _divide_rows(
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
